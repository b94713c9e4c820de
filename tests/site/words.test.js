/** Sentences and places that the page computes. */

import assert from 'node:assert/strict';
import test from 'node:test';

import {Catalogue} from '../../madviz/site/web/catalogue.js';
import {intact, noOcclusion} from '../../madviz/site/web/camera_state.js';
import {frustum, lineOnCanvas, rotate, viewpoint} from '../../madviz/site/web/geometry.js';
import {parseLink} from '../../madviz/site/web/link.js';
import {acts, openingEvents} from '../../madviz/site/web/opening.js';
import {conditionOf, nameOf} from '../../madviz/site/web/subsets.js';
import {badgeWords, changeWords, conditionWords, eventWords, guardWords, moveWords, outcomeWords, stateWords, subsetWords}
  from '../../madviz/site/web/words.js';

const CAMERAS = [['first', 'First person'], ['third_a', 'Third A']].map(([name, label]) =>
  ({name, label}));

test('subsets are named by their cameras', () => {
  assert.equal(subsetWords('all', CAMERAS), 'all cameras');
  assert.equal(subsetWords('first+third_a.depth', CAMERAS), 'First person + Third A depth');
});

test('a subset has the shortest name, as in Python', () => {
  const streams = ['first.rgb', 'first.depth', 'third_a.rgb', 'third_a.depth'];
  const name = (...on) => nameOf(streams.map((_, i) => on.includes(i)), streams);
  assert.equal(name(0, 2), 'rgb');
  assert.equal(name(0, 1), 'first');
  assert.equal(name(0, 1, 2), 'first+third_a.rgb');
  assert.equal(name(), 'none');
  assert.equal(nameOf([true, false, true], ['first', 'third_a', 'third_b']), 'first+third_b');
});

test('a change says what was done and what came of it', () => {
  const off = {...intact(), input: 'off'};
  const change = {camera: 'third_a', before: intact(), after: off, moved: false, step: 3,
    action_change: 0.312, q_before: 12.14, q_after: 9.81};
  assert.equal(changeWords(change, CAMERAS), 'Third A is off: action changed by 0.31, Q 12.1 → 9.8');
  assert.match(changeWords({...change, before: off, after: intact()}, CAMERAS), /^Third A is back:/);
  const black = {...intact(), occlusion: {...noOcclusion(), kind: 'black'}};
  assert.match(changeWords({...change, before: off, after: black}, CAMERAS), /^Third A sends black:/);
  const mute = {...change, action_change: NaN, q_after: NaN};
  assert.match(changeWords(mute, CAMERAS), /cannot act on that$/);
  assert.match(changeWords({...mute, q_after: 9, before: off, after: intact()}, CAMERAS),
    /^Third A is back: this policy can act again$/);
  const moved = {...change, after: intact(), moved: true};
  assert.match(changeWords({...moved, home: false}, CAMERAS), /^Third A has another place:/);
  assert.match(changeWords({...moved, home: true}, CAMERAS), /^Third A is back in its place:/);
});

test('a mark on the curve says what was done', () => {
  const event = {step: 3, camera: 'third_a'};
  assert.equal(eventWords({...event, state: {...intact(), input: 'off'}}, CAMERAS), 'Third A is off');
  assert.equal(eventWords({...event, move: {zoom: 2}}, CAMERAS), 'Third A moved');
  assert.equal(eventWords({...event, move: null}, CAMERAS), 'Third A is back in its place');
  assert.equal(eventWords({step: 3, camera: '', guard: true}, CAMERAS), 'guard on');
});

test('failures and moves in words', () => {
  const occlusion = {...noOcclusion(), kind: 'noise', strength: 0.5};
  assert.equal(stateWords({input: 'both', occlusion}), 'sends 50 % noise');
  const move = {forward: 0, right: -0.1, up: 0, pan: 5, tilt: 0, zoom: 1};
  assert.equal(moveWords(move), '0.10 m to the left, turned right 5°');
});

test('an episode that met its goal and lost it says so', () => {
  const world = {ended: true, success: false, success_any: true};
  assert.deepEqual(outcomeWords(world), {kind: 'bad', text: '✕ failed (goal met, then lost)'});
});

const TASK = {name: 't', label: 'Task', success: 'done', done: ['do it', 'did it'], horizon: 100, seeds: [5000, 5001]};
const policy = (name, method, task = 't') => ({name, label: name, method, task, streams: ['first'],
  cameras: CAMERAS, measured: {}, trained_subsets: ['all']});
const manifest = {tasks: [TASK], recordings: [{...policy('', 'mad', 'r'), policy: 'film',
  task_label: 'R', seeds: [7]}], policies: [policy('one', 'mad'), policy('two', 'merged-only')]};

test('a link is played as far as the site can, with a sentence for the rest', () => {
  const catalogue = new Catalogue(manifest, true);
  const check = hash => catalogue.checked(parseLink(hash).state);
  assert.deepEqual(check('#policy=one&vs=two&seed=5001'),
    {scene: {policy: 'one', vs: 'two', seed: 5001, events: []},
      problems: []});
  assert.match(check('#policy=gone').problems[0], /“gone” is not on this site/);
  assert.match(check('#policy=one&seed=9').problems[0], /Seed 9 has no start state/);
  assert.match(check('#policy=one&top=off').problems[0], /has no camera “top”/);
  assert.equal(check('#policy=one&vs=film').scene.vs, null);
  const blind = check('#policy=one&first=depth&first=off@9');
  assert.match(blind.problems[0], /gets no depth of “first”/);
  assert.deepEqual(blind.scene.events.map(({step, state}) => [step, state.input]), [[9, 'off']]);
  const late = check('#policy=one&first=off@99&third_a=black@100&guard=on@200');
  assert.equal(late.problems.length, 2);
  assert.match(late.problems[0], /“third_a” at step 100 comes after the last decision/);
  assert.deepEqual(late.scene.events.map(one => one.step), [99]);
  const alone = check('#policy=one&b.first=off@4&a.first=off@5');
  assert.match(alone.problems.join(), /^“first” at step 4 is for side B, which is not here/);
  assert.deepEqual(alone.scene.events.map(one => one.step), [5]);
  assert.equal(check('#policy=one&vs=two&b.first=off@4').scene.events.length, 1);
});

test('without a simulation there are recordings alone', () => {
  assert.deepEqual(new Catalogue(manifest, false).entries.map(one => one.name), ['film']);
  const opening = new Catalogue(manifest, true).opening();
  assert.deepEqual(opening.entries.map(one => one.name), ['one', 'two']);
  const told = {first: 'two', second: 'one', camera: 'third_a', step: 9, seed: 5001};
  const other = new Catalogue({...manifest, opening: told}, true).opening();
  assert.deepEqual([other.entries[0].name, other.camera, other.step, other.seed],
    ['two', 'third_a', 9, 5001]);
});

test('a point ahead is in the middle, one to the right is at the right', () => {
  const view = viewpoint({target: [0, 0, 0], distance: 1, azimuth: 0, elevation: 0, fovy: 45});
  assert.ok(Math.abs(view.position[0] + 1) < 1e-12, 'it stands back and looks along +x');
  const line = lineOnCanvas([0, 0, 0], [0, -0.2, 0], view, 100, 100);
  const right = 50 + 50 * 0.2 / Math.tan(Math.PI / 8);
  [50, 50, right, 50].forEach((value, i) => assert.ok(Math.abs(line[i] - value) < 1e-9));
  assert.equal(lineOnCanvas([-2, 0, 0], [-3, 0, 0], view, 100, 100), null, 'behind');
});

test('a frustum is as wide as its field of view', () => {
  const pose = {position: [0, 0, 1], wxyz: [1, 0, 0, 0], fovy: 90};
  const {corners} = frustum(pose, 0.5);
  corners[2].forEach((value, i) => assert.ok(Math.abs(value - [0.5, 0.5, 1.5][i]) < 1e-12));
  const turned = rotate([Math.SQRT1_2, 0, 0, Math.SQRT1_2], [1, 0, 0]);
  turned.forEach((value, i) => assert.ok(Math.abs(value - [0, 1, 0][i]) < 1e-12));
});

test('what a guard has noticed is said, and stands on the picture', () => {
  const noticed = {camera: 'third_a', kind: 'late', since: 23, why: 'five steps'};
  assert.equal(badgeWords(noticed), 'LATE · left out since step 23');
  assert.equal(guardWords({guard: [noticed], mask: [true, false]}, CAMERAS),
    'Guard: Third A is late since step 23 (five steps): left out.');
  assert.match(guardWords({guard: [noticed], mask: [false, false]}, CAMERAS), /No camera is left/);
  assert.equal(guardWords({guard: [], mask: [true, true]}, CAMERAS), '');
  assert.equal(conditionWords({subset: 'all', occlusions: 'first:black', guarded: true}, CAMERAS),
    'with guard · all cameras · first:black');
});

test('each failure has a row name of its own', () => {
  const state = occlusion => ({input: 'both', occlusion: {...noOcclusion(), ...occlusion}});
  const row = (occlusion, moves = {}) => conditionWords(
    conditionOf(['first', 'third_a'], {first: state(occlusion), third_a: intact()}, moves), CAMERAS);
  assert.equal(row({}), 'all cameras');
  assert.equal(row({kind: 'black'}), 'all cameras · first:black');
  assert.equal(row({kind: 'noise', strength: 0.1}), 'all cameras · first:noise strength=0.1');
  assert.equal(row({kind: 'noise', strength: 0.5}), 'all cameras · first:noise strength=0.5');
  const move = {forward: 0, right: -0.1, up: 0, pan: 5, tilt: 0, zoom: 1};
  assert.equal(row({kind: 'patch', height: 0.2}, {third_a: move}),
    'all cameras · first:patch width=0.4 height=0.2, third_a:moved right=-0.1 pan=5');
});

test('the opening has three acts where a guard is fitted, else the one that drops a camera', () => {
  const entry = {label: 'MAD', cameras: CAMERAS, guard: {path: 'g', bytes: 1, unpacked: 1}};
  const opening = {entries: [entry, entry], camera: 'first', step: 15, seed: 5000};
  const three = acts(opening);
  assert.deepEqual(three.map(act => [act.how, act.guard]), [['', false], ['black', false], ['black', true]]);
  assert.deepEqual(three.map(act => act.asks), [false, true, false]);
  assert.equal(openingEvents(opening, three[0]).length, 0);
  assert.equal(openingEvents(opening, three[2])[0].state.occlusion.kind, 'black');
  const without = {...opening, entries: [entry, {...entry, guard: undefined}]};
  assert.deepEqual(acts(without), [{how: 'off', asks: true, guard: false}]);
});
