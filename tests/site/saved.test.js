/** Saved sessions from anybody: what is written is read again, and what is wrong has a sentence. */

import assert from 'node:assert/strict';
import test from 'node:test';

import {noOcclusion} from '../../madviz/site/web/camera_state.js';
import {readEpisode, savedEpisode, savedSession} from '../../madviz/site/web/saved.js';

const POLICY = {name: 'one', digest: 'd', streams: ['first', 'third_a'],
  cameras: [{name: 'first'}, {name: 'third_a'}]};
const PATCH = {kind: 'patch', strength: 1, x: 0.2, y: 0.5, width: 0.4, height: 0.3};
const EVENTS = [
  {step: 0, camera: 'first', state: {input: 'off', occlusion: noOcclusion()}},
  {step: 7, camera: 'third_a', state: {input: 'both', occlusion: PATCH}},
  {step: 9, camera: 'first', move: {forward: 0, right: 0.1, up: 0, pan: 5, tilt: 0, zoom: 1}},
  {step: 12, camera: 'first', move: null},
];
const PLAYED = {
  policy: {spec: POLICY}, task: {said: {name: 'metaworld/hammer'}}, events: EVENTS, started: 1,
  actions: [Float32Array.of(0, 1, 0, 1)], flags: [true], seed: 5000, ended: true,
  physics: {success: true}, successAny: true,
};

async function written() {
  return savedSession([await savedEpisode(PLAYED)], {madviz: '0'});
}

test('what was saved is read again', async () => {
  const found = readEpisode(await written(), undefined, [POLICY]);
  assert.deepEqual(found, {policy: 'one', seed: 5000, events: EVENTS});
});

test('a guard is part of the policy in a file', async () => {
  const spec = {...POLICY, guard: {}, guarded_digest: 'g'};
  const on = {step: 0, camera: '', guard: true}, off = {step: 8, camera: '', guard: false};
  const played = {...PLAYED, policy: {spec}, started: 2,
    events: [EVENTS[0], on, EVENTS[1], off, ...EVENTS.slice(2)]};
  const episode = await savedEpisode(played);
  assert.deepEqual(episode.policy, {name: 'one (guarded)', digest: 'g'});
  const found = readEpisode(savedSession([episode], {}), undefined, [spec]);
  assert.deepEqual(found.policy, 'one');
  assert.deepEqual(found.events, [on, EVENTS[0], EVENTS[1], off, ...EVENTS.slice(2)]);
  assert.throws(() => readEpisode(savedSession([episode], {}), undefined, [POLICY]), /a policy of this/);
  assert.deepEqual(episode.commands[1], {step: 8, policy: 'one', digest: 'd'});
  episode.commands[1].policy = 'two';
  assert.throws(() => readEpisode(savedSession([episode], {}), undefined, [spec]), /one policy/);
});

test('a file says who made it, and the hashes of what was done', async () => {
  const file = JSON.parse(await written());
  assert.equal(file.made_by, 'site');
  assert.match(file.episodes[0].sha256.actions, /^[0-9a-f]{64}$/);
  assert.notEqual(file.episodes[0].sha256.actions, '0'.repeat(64));
});

/** @param {(episode: any, file: any) => void} change */
async function changed(change) {
  const file = JSON.parse(await written());
  change(file.episodes[0], file);
  return JSON.stringify(file);
}

const WRONG = {
  'no JSON': async () => '{"schema": 1',
  'no object': async () => 'null',
  'another schema': () => changed((_, file) => { file.schema = 2; }),
  'no episode': () => changed((_, file) => { file.episodes = []; }),
  'an unknown policy': () => changed(one => { one.policy.name = '<b>x</b>'; }),
  'a seed that is a text': () => changed(one => { one.seed = '5000'; }),
  'an unknown camera': () => changed(one => { one.commands[0].camera = '__proto__'; }),
  'an unknown input': () => changed(one => { one.commands[0].input = 'x'; }),
  'depth, where a policy has colour only': () => changed(one => { one.commands[0].input = 'depth'; }),
  'a step below 0': () => changed(one => { one.commands[0].step = -1; }),
  'a strength above 1': () => changed(one => { one.commands[0].occlusion.strength = 2; }),
  'a move that is far': () => changed(one => { one.commands[1].move.right = 50; }),
  'commands that are none': () => changed(one => { one.commands = [null]; }),
};

for (const [name, make] of Object.entries(WRONG)) {
  test(`${name} is refused in a sentence`, async () => {
    const text = await make();
    assert.throws(() => readEpisode(text, undefined, [POLICY]), /^Error: Expected .*\.$/);
  });
}
