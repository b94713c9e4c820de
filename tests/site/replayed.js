/**
 * Replays an episode with the site's own physics, without a browser: `tests/test_site_physics.py`
 * compares where everything is after each decision with where it is in Python.
 *
 * Reads a question as JSON from standard input: the folder of the npm packages, the task's line of a
 * manifest, files with the model and the start states, a seed and actions.
 */
import {readFileSync} from 'node:fs';
import {pathToFileURL} from 'node:url';

import {Physics} from '../../madviz/site/web/physics.js';

const asked = JSON.parse(readFileSync(0, 'utf8'));
const module = pathToFileURL(`${asked.packages}/@mujoco/mujoco/mujoco.js`).href;
const {default: load} = await import(module);

/** @param {string} path */
function bytes(path) {
  const read = readFileSync(path);
  return read.buffer.slice(read.byteOffset, read.byteOffset + read.byteLength);
}

const physics = new Physics(await load(), asked.task, bytes(asked.model), bytes(asked.starts));
physics.begin(asked.seed);
const rows = asked.actions.map((/** @type {number[]} */ action) => {
  physics.act(Float32Array.from(action));
  return {qpos: [...physics.data.qpos], state: [...physics.state], success: physics.success};
});
console.log(JSON.stringify(rows));
