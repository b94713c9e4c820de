/** Recorded episodes under a schedule and switches: what a frame says was done, on each side. */

import assert from 'node:assert/strict';
import test from 'node:test';

import {Player} from '../../madviz/site/web/player.js';

const side = {policy: 'mad', horizon: 25, seeds: [5000, 5001],
  cameras: [{name: 'first'}, {name: 'third_a'}], streams: ['first', 'third_a'], files: {}};
const off = {input: 'off'}, on = {input: 'both'};

/** A player that tells nobody, so that nothing is drawn. @param {number} sides */
function played(sides) {
  const player = new Player('', {recordings: [side]}, () => {});
  player.tell = () => Promise.resolve();
  player.choose(Array(sides).fill('mad'));
  return player;
}

const brief = events => events.map(({step, camera, state}) => `${camera} ${state.input} ${step}`);

/** @param {any} player @param {number} step */
function upTo(player, step) {
  while (player.step < step) player.advance();
}

test('a camera of the schedule works again when the episode begins anew', () => {
  const player = played(1);
  player.schedule = [{step: 15, camera: 'first', state: off, side: 'both'}];
  player.begin(5000);
  upTo(player, 25);
  assert.deepEqual(brief(player.journals[0]), ['first off 15']);
  player.begin(5000);
  assert.equal(player.cameras[0].first.input, 'both');
  assert.deepEqual(player.journals[0], []);
});

test('the journal has a camera that a visitor switches on again', () => {
  const player = played(1);
  player.schedule = [{step: 15, camera: 'first', state: off, side: 'both'}];
  player.begin(5000);
  upTo(player, 17);
  player.set('both', 'first', on);
  assert.deepEqual(brief(player.journals[0]), ['first off 15', 'first both 17']);
  player.set('both', 'first', off);
  assert.deepEqual(brief(player.journals[0]), ['first off 15', 'first off 17'], 'the last of a step');
});

test('how an episode ended stands, whatever is switched or pressed then', async () => {
  const player = played(1);
  player.files = {};
  player.begin(5000);
  upTo(player, 25);
  player.set('both', 'first', off);
  await assert.rejects(player.world(side, 0), /no episode was recorded with all on seed 5000/);
  await player.obey({kind: 'StepOnce'});
  assert.equal(player.phase, 'ended');
  player.begin(5000);
  await assert.rejects(player.world(side, 0), /no episode was recorded with third_a on seed 5000/);
});

test('a switch knows what it was before, and how an episode began is no switch', () => {
  const player = played(1);
  player.set('both', 'third_a', off);
  player.begin(5001);
  assert.equal(player.journals[0][0].from, undefined);
  upTo(player, 4);
  player.set('both', 'first', off);
  upTo(player, 6);
  player.set('both', 'first', on);
  const [, dropped, back] = player.journals[0];
  assert.deepEqual([dropped.from.subset, dropped.from.before.input], ['first', 'both']);
  assert.deepEqual([back.from.subset, back.from.before.input], ['none', 'off']);
});

test('a side hears of its own switches alone', () => {
  const player = played(2);
  player.schedule = [{step: 3, camera: 'first', state: off, side: 'first'}];
  player.begin(5000);
  upTo(player, 5);
  assert.deepEqual(player.journals.map(brief), [['first off 3'], []]);
  assert.deepEqual(player.cameras.map(one => one.first.input), ['off', 'both']);
});

test('what was off before the episode is off from its start', () => {
  const player = played(1);
  player.set('both', 'third_a', off);
  player.begin(5001);
  assert.deepEqual(brief(player.journals[0]), ['third_a off 0']);
});

test('going on by itself, chosen after the end, goes on', async () => {
  const player = played(1);
  let shown = 0;
  player.tell = async () => { shown += 1; };
  await player.obey({kind: 'SetAutoNext', on: true});
  assert.equal(shown, 1, 'a frame plans what comes');
});

test('a scene opens with its schedule', async () => {
  const player = played(1);
  const events = [{step: 0, camera: 'first', state: off, side: 'both'}];
  await player.obey({kind: 'Open', base: '', policy: 'mad', seed: 5000, events});
  assert.deepEqual(brief(player.journals[0]), ['first off 0']);
  assert.equal(player.journals[0][0].from, undefined, 'that is how it begins, and no switch');
  await player.obey({kind: 'Open', base: '', policy: 'mad', seed: 5000});
  assert.deepEqual(player.journals[0], []);
});
