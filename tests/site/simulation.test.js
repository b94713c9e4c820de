/** One simulation on a fake robot: what its journal says of the guard. */

import assert from 'node:assert/strict';
import {readFileSync} from 'node:fs';
import test from 'node:test';

import {intact} from '../../madviz/site/web/camera_state.js';
import {Simulation} from '../../madviz/site/web/simulation.js';

const VALUES = JSON.parse(readFileSync(new URL('../guard_cases.json', import.meta.url))).values;
const SIZE = VALUES.size[0];

/** A simulation whose camera shows other pixels at each step. @param {object | null} guard */
function made(guard) {
  const physics = {step: 0, state: [2.1, 2.1], success: false, data: {},
    begin() { this.step = 0; }, act() { this.step += 1; }, fingertips: () => [0, 0, 0]};
  const spec = {name: 'one', cameras: [{name: 'camera'}], streams: ['camera']};
  const read = async () => ({features: new Float32Array(4), merged: new Float32Array(4),
    action: new Float32Array(4), q: new Float32Array(1)});
  const found = new Simulation({said: {name: 'toy/x', horizon: 9}, scene: {}}, physics, {},
    {spec, guard, read});
  found.draw = async () => ({camera: {width: SIZE, height: SIZE,
    rgba: Uint8ClampedArray.from({length: 4 * SIZE * SIZE}, (_, i) => (37 * i + physics.step) % 200)}});
  return found;
}

test('the journal has the guard where it changes, and a schedule switches it again', async () => {
  const one = made(VALUES);
  await one.begin(1, []);
  await one.setGuard(false);
  assert.deepEqual(one.events, [], 'it was off');
  await one.advance();
  await one.setGuard(true);
  await one.setGuard(true);
  const on = {step: 1, camera: '', guard: true};
  assert.deepEqual(one.events, [on]);
  await one.begin(1, []);
  assert.deepEqual(one.events, [{...on, step: 0}], 'it stays on in the next episode');
  one.restore([{...on, side: 'both'}]);
  await one.begin(1, []);
  assert.equal(one.guard, null);
  await one.advance();
  await one.set(on);
  assert.notEqual(one.guard, null);
  assert.deepEqual(one.events, [on]);
});

test('a camera that is put back is not said to be moved', async () => {
  const one = made(null);
  await one.begin(1, []);
  const homes = [];
  for (const event of [{move: {zoom: 2}}, {move: null}, {state: intact()}]) {
    await one.set({camera: 'camera', ...event});
    homes.push([one.change.moved, one.change.home]);
  }
  assert.deepEqual(homes, [[true, false], [true, true], [false, false]]);
});

test('a policy without a guard has none, whatever is asked', async () => {
  const one = made(null);
  await one.begin(1, [{step: 0, camera: '', guard: true}]);
  await one.setGuard(true);
  assert.deepEqual([one.guard, one.events], [null, []]);
});
