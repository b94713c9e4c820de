/** The words at the end of an episode: the same table as Python's, and what befell the cameras. */

import assert from 'node:assert/strict';
import {readFileSync} from 'node:fs';
import test from 'node:test';

import {intact, noOcclusion} from '../../madviz/site/web/camera_state.js';
import {deedsOf, departureOf, endingOf, endingParts, guessWords} from '../../madviz/site/web/ending.js';
import {Tally, wilson} from '../../madviz/site/web/statistics.js';

const CASES = JSON.parse(readFileSync(new URL('./endings.json', import.meta.url), 'utf8'));
const CAMERAS = [['first', 'First person'], ['third_a', 'Third A']].map(([name, label]) =>
  ({name, label}));
const OFF = {...intact(), input: 'off'};
const BLACK = {...intact(), occlusion: {...noOcclusion(), kind: 'black'}};
const words = parts => [parts.done, parts.result, parts.cameOfIt, parts.measured].filter(Boolean).join(' ');

test('the words are those of the table', () => {
  assert.ok(CASES.length > 4);
  for (const {done, sides, words: expected, guess, guess_words} of CASES) {
    const ended = sides.map(({successes, n, ...side}) => ({...side,
      rate: {value: n ? successes / n : NaN, interval: wilson(successes, n), n}}));
    const parts = endingParts(ended, done);
    assert.equal(words(parts), expected);
    if (guess) assert.equal(guessWords(guess, parts.winners), guess_words);
  }
});

test('what befell a camera is what its decisions saw', () => {
  const events = [{step: 3, camera: 'first', state: OFF}, {step: 5, camera: 'third_a', state: BLACK},
    {step: 7, camera: 'third_a', state: intact()}, {step: 100, camera: 'third_a', state: OFF}];
  assert.deepEqual(deedsOf({events, horizon: 100}, CAMERAS),
    [['First person', 'was dropped', 3], ['Third A', 'was broken', null]]);
  const noise = (step, strength, x = 0.5) => ({step, camera: 'first',
    state: {...intact(), occlusion: {...noOcclusion(), kind: 'noise', strength, x}}});
  const weaker = [noise(4, 1), noise(7, 0.5), noise(9, 0.5, 0.1)];
  assert.deepEqual(deedsOf({events: weaker, horizon: 100}, CAMERAS),
    [['First person', 'sent 50 % noise', 7]], 'the step from which on the words hold');
  const undone = [{step: 3, camera: 'first', state: OFF}, {step: 3, camera: 'first', state: intact()}];
  assert.deepEqual(deedsOf({events: undone, horizon: 100}, CAMERAS), []);
});

test('an episode ends in words where something was done, with what is known of it', () => {
  const events = [{step: 0, camera: 'first', state: OFF}];
  const world = {policy: 'one', ended: true, success: true, horizon: 100, events,
    condition: {subset: 'third_a', occlusions: ''}};
  const entry = {label: 'MAD', done: ['do it', 'did it'], cameras: CAMERAS,
    measured: {third_a: {success: 0.9, ci95: [0.83, 0.94], n: 100}}};
  const ending = endingOf([world], [entry], new Tally());
  assert.equal(words(ending),
    'First person was dropped from the start. MAD did it. Over 100 episodes: 0.90 [0.83, 0.94].');
  const touchedSince = {...world, condition: {subset: 'none', occlusions: ''}, decided: world.condition};
  assert.equal(words(endingOf([touchedSince], [entry], new Tally())), words(ending));
  assert.equal(endingOf([{...world, events: []}], [entry], new Tally()), null);
  assert.equal(endingOf([{...world, ended: false}], [entry], new Tally()), null);
});

test('a recording says that its cameras were so from the start', () => {
  const world = {policy: 'one', ended: true, success: false, horizon: 100,
    events: [{step: 99, camera: 'first', state: OFF}], condition: {subset: 'third_a', occlusions: ''}};
  const entry = {label: 'MAD', done: ['do it', 'did it'], cameras: CAMERAS, measured: {}, recorded: true};
  const result = (step, recorded) => endingOf([{...world, events: [{...world.events[0], step}]}],
    [{...entry, recorded}], new Tally()).result;
  assert.equal(result(99, true),
    'MAD did not do it. (This was recorded with the cameras as at the end, from the start.)');
  assert.equal(result(0, true), 'MAD did not do it.');
  assert.equal(result(99, false), 'MAD did not do it.');
});

test('how far two paths are apart, and from which step on', () => {
  const straight = new Float32Array(15), bent = straight.slice();
  bent.set([0.004, 0, 0, 0.03, 0, 0, 0.02, 0, 0], 6);
  const [largest, step] = departureOf({since: 10, taken: bent, intact: straight});
  assert.ok(Math.abs(largest - 0.03) < 1e-6);
  assert.equal(step, 13);
  assert.equal(departureOf({since: 10, taken: straight, intact: straight})[1], null);
  assert.equal(departureOf(null), null);
});
