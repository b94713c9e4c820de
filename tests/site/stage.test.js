/** The worker's commands, without a simulator: what is left out, and what ends a run. */

import assert from 'node:assert/strict';
import test from 'node:test';

import {Episodes} from '../../madviz/site/web/episodes.js';
import {Stage} from '../../madviz/site/web/stage.js';

const move = (camera, forward) => ({kind: 'MoveCamera', side: 'both', camera, move: {forward}});

/** Which of `commands` are obeyed. @param {any[]} commands */
function obeyed(commands) {
  const waiting = {queue: [...commands]}, kept = [];
  for (let one = waiting.queue.shift(); one; one = waiting.queue.shift()) {
    if (!Stage.prototype.overtaken.call(waiting, one)) kept.push(one);
  }
  return kept;
}

test('of a slider that is dragged the last place counts', () => {
  const dragged = [1, 2, 3].map(n => move('first', n));
  assert.deepEqual(obeyed(dragged), [dragged[2]]);
  const both = [move('first', 1), move('third_a', 1), move('first', 2)];
  assert.deepEqual(obeyed(both), both.slice(1));
});

test('nothing overtakes another command, side or kind', () => {
  const step = {kind: 'StepOnce'};
  const apart = [move('first', 1), step, move('first', 2)];
  assert.deepEqual(obeyed(apart), apart);
  const sides = [{...move('first', 1), side: 'first'}, {...move('first', 2), side: 'second'}];
  assert.deepEqual(obeyed(sides), sides);
  const kinds = [{kind: 'SetCamera', side: 'both', camera: 'first'}, move('first', 2)];
  assert.deepEqual(obeyed(kinds), kinds);
  assert.deepEqual(obeyed([step, step]), [step, step]);
});

test('a visitor who switches the guard has the last word', async () => {
  const off = {step: 4, side: 'both', camera: 'first'};
  const asked = [];
  const stage = {schedule: [{step: 0, side: 'both', camera: '', guard: true}, off], guarded: false,
    sides: [{setGuard: async on => asked.push(on)}], readAll: async () => {}};
  await Stage.prototype.onSetGuard.call(stage, {on: false});
  assert.deepEqual([stage.schedule, stage.guarded, asked], [[off], false, [false]]);
});

test('a run that is left says that it is over, once', () => {
  const said = [];
  const stage = {say: one => said.push(one), tellMany: Episodes.prototype.tellMany,
    many: {done: 2, of: 20, outcomes: [], shown: 0}};
  Episodes.prototype.stopMany.call(stage);
  Episodes.prototype.stopMany.call(stage);
  assert.deepEqual(said, [{kind: 'Run', done: 2, of: 20, ended: true, outcomes: []}]);
  assert.equal(stage.many, null);
});
