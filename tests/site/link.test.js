/** Links: what is written is read again, and nothing that a chat makes of one throws. */

import assert from 'node:assert/strict';
import test from 'node:test';

import {intact, noOcclusion} from '../../madviz/site/web/camera_state.js';
import {formatLink, mergedEvents, parseLink} from '../../madviz/site/web/link.js';

const KINDS = ['none', 'black', 'noise', 'freeze', 'blur', 'patch'];
const SHARES = ['strength', 'x', 'y', 'width', 'height'];

/** Numbers from 0 to 1 that a seed decides (mulberry32). */
function numbers(seed) {
  return () => {
    seed = seed + 0x6D2B79F5 | 0;
    let mixed = Math.imul(seed ^ seed >>> 15, 1 | seed);
    mixed = mixed + Math.imul(mixed ^ mixed >>> 7, 61 | mixed) ^ mixed;
    return ((mixed ^ mixed >>> 14) >>> 0) / 2 ** 32;
  };
}

function anyState(random) {
  const pick = list => list[Math.floor(random() * list.length)];
  const state = {input: pick(['rgb', 'depth', 'both', 'off']), occlusion: noOcclusion()};
  state.occlusion.kind = pick(KINDS);
  const told = {patch: SHARES, none: []}[state.occlusion.kind] ?? ['strength'];
  for (const name of told) state.occlusion[name] = Math.round(random() * 1000) / 1000;
  return state;
}

function anyMove(random) {
  const metres = () => Math.round((2 * random() - 1) * 1000) / 1000 || 0;
  const degrees = () => Math.round((180 * random() - 90) * 10) / 10 || 0;
  return {forward: metres(), right: metres(), up: metres(), pan: degrees(), tilt: degrees(),
    zoom: Math.round((0.5 + 1.5 * random()) * 100) / 100};
}

function anyEvents(random) {
  const events = Array.from({length: Math.floor(random() * 8)}, () => ({
    step: Math.floor(random() * 100),
    side: ['first', 'second', 'both'][Math.floor(random() * 3)],
    camera: ['first', 'third_a', 'third_b', 'top'][Math.floor(random() * 4)],
    ...random() < 0.3 ? {move: random() < 0.2 ? null : anyMove(random)} : {state: anyState(random)},
  }));
  return events.sort((one, other) => one.step - other.step);
}

test('what is written is read again, whatever the state', () => {
  for (let seed = 0; seed < 2000; seed += 1) {
    const random = numbers(seed);
    const state = {policy: random() < 0.1 ? null : 'metaworld-hammer-mad-light',
      vs: random() < 0.5 ? null : 'metaworld-hammer-merged-only-light',
      seed: random() < 0.1 ? null : Math.floor(random() * 2 ** 31), events: anyEvents(random)};
    const link = formatLink(state);
    assert.deepEqual(parseLink(link), {state, problems: []}, link);
  }
});

test('a link that a chat cut, changed or mixed up never throws, and what is wrong is said', () => {
  const letters = '#&=@:.-%+aé 0129_\u0000\ud800', random = numbers(7);
  for (let round = 0; round < 5000; round += 1) {
    let link = formatLink({policy: 'a-policy', vs: null, seed: 5000, events: anyEvents(random)});
    for (let change = 0; change < 1 + 4 * random(); change += 1) {
      const at = Math.floor(random() * link.length);
      const letter = letters[Math.floor(random() * letters.length)];
      link = link.slice(0, at) + (random() < 0.5 ? letter : '') + link.slice(at + 1);
    }
    const {state, problems} = parseLink(link);
    for (const problem of problems) assert.match(problem, /^The link[^]*\.$/);
    for (const event of state.events) {
      assert.ok(event.step >= 0 && event.step <= 9999);
      if (event.state) {
        for (const name of SHARES) {
          assert.ok(event.state.occlusion[name] >= 0 && event.state.occlusion[name] <= 1);
        }
      } else if (event.move) {
        assert.ok(Object.values(event.move).every(Number.isFinite));
      } else assert.equal(event.move, null);
    }
    assert.deepEqual(parseLink(formatLink(state)).state, state, 'what was read can be written');
  }
});

test('the forms of the command line are read', () => {
  const {state, problems} = parseLink('#third_a=off@20-40&first=noise:0.5@10&b.third_b=black');
  assert.deepEqual(problems, []);
  const off = {...intact(), input: 'off'};
  const noise = {input: 'both', occlusion: {...noOcclusion(), kind: 'noise', strength: 0.5}};
  const black = {input: 'both', occlusion: {...noOcclusion(), kind: 'black'}};
  assert.deepEqual(state.events, [
    {step: 0, side: 'second', camera: 'third_b', state: black},
    {step: 10, side: 'both', camera: 'first', state: noise},
    {step: 20, side: 'both', camera: 'third_a', state: off},
    {step: 40, side: 'both', camera: 'third_a', state: intact()},
  ]);
});

test('what cannot be read is left out with a sentence, and the rest holds', () => {
  const wrong = ['third_a=offf@20', 'first=noise:2', 'first=off@20-10', 'seed=-1', 'seed=99999999999',
    'policy=../../etc', 'first=patch:1:2', 'FIRST=off', 'first=move:9:0:0:0:0:1', 'x=%E0%A4%A',
    'first=move:0:0:0', 'first=off@12345', '__proto__=off;', 'first=rgb:depth', 'first='];
  for (const part of wrong) {
    const {state, problems} = parseLink(`#policy=a-policy&${part}&third_b=off@5`);
    assert.equal(problems.length, 1, part);
    assert.equal(state.policy, 'a-policy');
    assert.equal(state.events.length, 1);
  }
});

test('an endless link is not read', () => {
  const {state, problems} = parseLink(`#${'first=off&'.repeat(2000)}`);
  assert.equal(state.events.length, 0);
  assert.match(problems[0], /8000 characters/);
});

test('journals of both sides: what is the same is said once', () => {
  const off = {...intact(), input: 'off'};
  const start = {step: 0, camera: 'first', state: intact()};
  const both = {step: 4, camera: 'third_a', state: off};
  const alone = {step: 9, camera: 'third_b', state: off};
  const merged = mergedEvents([start, both], [start, both, alone]);
  assert.deepEqual(merged, [{...both, side: 'both'}, {...alone, side: 'second'}]);
  assert.deepEqual(mergedEvents([both], null), [{...both, side: 'both'}]);
});

test('a camera that was off at the first step and works again is on in the link', () => {
  const journal = [{...intact(), input: 'off'}, intact()].map(state => ({step: 0, camera: 'first', state}));
  const state = {policy: 'one', vs: null, seed: 5000, events: mergedEvents(journal, null)};
  assert.equal(formatLink(state), '#policy=one&seed=5000&first=off&first=on');
});

test('a guard travels in a link', () => {
  const on = {step: 0, camera: '', guard: true};
  const later = [{...on, step: 30}, {...on, step: 40, guard: false}];
  const linked = events => formatLink({policy: 'one', vs: null, seed: 5000, events});
  assert.equal(linked(mergedEvents([on], null)), '#policy=one&seed=5000&guard=on');
  const text = linked(mergedEvents([], later)); // Side A has none.
  assert.equal(text, '#policy=one&seed=5000&guard=on@30&guard=off@40');
  const both = later.map(event => ({...event, side: 'both'}));
  assert.deepEqual(parseLink(text).state.events, both);
  assert.deepEqual(parseLink('#guard=on@30-40').state.events, both);
  assert.equal(parseLink('#policy=one&guard=perhaps').problems.length, 1);
});
