/**
 * A recorded episode: read from its file, and one time step of it as a frame has it.
 *
 * A file is a gzipped safetensors file. T counts time steps from 0 to the horizon, V streams, N
 * subsets, A numbers of an action; a sheet is a WebP picture with one tile for each step.
 *
 *     sheet          the pictures that reached the policy: tile T x V + V's index, row by row
 *     scene          the scene from outside, every SCENE_EVERY steps
 *     norms (T V)    merged (T G): the merged feature, each group of numbers by its norm
 *     action (T A)   q (T)   readout_action (T N A)   readout_q (T N)   success (T)
 *     metadata       tile, scene_width, scene_height, scene_every, subsets
 */

import {fetchGzip} from './files.js';
import {intact} from './camera_state.js';
import {readTensors} from './tensors.js';

/** @typedef {import('./messages.js').Picture} Picture */
/** @typedef {import('./messages.js').SiteRecording} SiteRecording */
/** @typedef {import('./messages.js').World} World */
/**
 * What was done to a camera; `from`: how it was, and which cameras were on. Without it, that is how
 * the episode began.
 * @typedef {import('./messages.js').CameraEvent & {from?: {before: import('./messages.js').CameraState,
 *   subset: string}}} JournalEvent
 */
/** @typedef {{context: CanvasRenderingContext2D, width: number, height: number}} Sheet */
/** @typedef {{sheet: Sheet, scene: Sheet, sceneEvery: number, subsets: string[],
 *   tensors: Record<string, import('./tensors.js').Tensor>}} Episode */

/**
 * @param {string} base
 * @param {import('./messages.js').SiteFile} file
 * @returns {Promise<Episode>}
 */
export async function loadEpisode(base, file) {
  const {tensors, metadata} = readTensors(await fetchGzip(base, file));
  const tile = Number(metadata.tile);
  return {tensors, subsets: JSON.parse(metadata.subsets),
    sceneEvery: Number(metadata.scene_every),
    sheet: await sheetOf(tensors.sheet, tile, tile),
    scene: await sheetOf(tensors.scene, Number(metadata.scene_width),
      Number(metadata.scene_height))};
}

/** @param {import('./tensors.js').Tensor} bytes @param {number} width @param {number} height
 * @returns {Promise<Sheet>} */
async function sheetOf(bytes, width, height) {
  const file = new Blob([/** @type {Uint8Array<ArrayBuffer>} */ (bytes.data)], {type: 'image/webp'});
  const bitmap = await createImageBitmap(file);
  const canvas = document.createElement('canvas');
  [canvas.width, canvas.height] = [bitmap.width, bitmap.height];
  const context = canvas.getContext('2d', {willReadFrequently: true});
  if (!context) throw new Error('this browser has no canvas');
  context.drawImage(bitmap, 0, 0);
  bitmap.close();
  return {context, width, height};
}

/** @param {Sheet} sheet @param {number} index @returns {Picture} */
function tileOf({context, width, height}, index) {
  const columns = Math.floor(context.canvas.width / width);
  const x = index % columns * width, y = Math.floor(index / columns) * height;
  return {width, height, rgba: context.getImageData(x, y, width, height).data};
}

/**
 * @param {Episode} episode
 * @param {SiteRecording} side
 * @param {{step: number, episode: number, seed: number, subset: string,
 *   cameras: World['cameras'], events: JournalEvent[]}} now
 * @returns {World}
 */
export function worldAt({tensors, sheet, scene, sceneEvery, subsets}, side, now) {
  const {step} = now, actions = tensors.action.shape[1];
  /** @param {string} name */
  const row = name => {
    const {shape, data} = tensors[name], size = shape.slice(1).reduce((a, b) => a * b, 1);
    return Float32Array.from(data.subarray(step * size, (step + 1) * size));
  };
  const pictures = Object.fromEntries(side.streams.map((stream, index) =>
    [stream, tileOf(sheet, step * side.streams.length + index)]));
  const success = tensors.success.data.subarray(0, step + 1);
  return {policy: side.policy, task: side.task, episode: now.episode, seed: now.seed, step,
    horizon: side.horizon, mask: side.streams.map(stream => now.cameras[stream].input !== 'off'),
    cameras: {...now.cameras}, moves: {}, guard: null, condition: {subset: now.subset, occlusions: ''},
    events: now.events, arrived: pictures, poses: {},
    geom_poses: new Float32Array(0), scene: tileOf(scene, Math.floor(step / sceneEvery)),
    norms: row('norms'), streams: side.streams, merged: row('merged'), action: row('action'),
    q: row('q')[0], readout: {step, subsets, action: row('readout_action'), q: row('readout_q')},
    success: Boolean(success[step]), success_any: success.some(Boolean),
    ended: step >= side.horizon, change: changeNow(now, subsets, row, actions)};
}

/**
 * What the newest switch did, read from the episode it goes over to: how far the actions with the
 * cameras before it and after it are apart at this step. How an episode began is no switch.
 * @param {{step: number, subset: string, events: JournalEvent[]}} now
 * @param {string[]} subsets
 * @param {(name: string) => Float32Array} row
 * @param {number} size Of an action.
 * @returns {World['change']}
 */
function changeNow({step, subset, events}, subsets, row, size) {
  const event = events.findLast(one => one.step <= step && one.from);
  if (!event?.from || !event.state) return null;
  const actions = row('readout_action'), q = row('readout_q');
  const [before, after] = [subsets.indexOf(event.from.subset), subsets.indexOf(subset)];
  if (before < 0 || after < 0 || before === after) return null;
  const apart = Math.hypot(...Array.from({length: size}, (_, i) =>
    actions[after * size + i] - actions[before * size + i]));
  return {camera: event.camera, before: event.from.before, after: event.state, moved: false,
    step: event.step, action_change: apart, q_before: q[before], q_after: q[after]};
}
