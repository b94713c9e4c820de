/**
 * Which streams are present, and the names of subsets: the small language of `madviz/subsets.py`.
 */
import {cameraOf, modalityOf} from './streams.js';

/** @typedef {import('./messages.js').CameraState} CameraState */
/** @typedef {import('./messages.js').Displacement} Displacement */
/** @typedef {import('./messages.js').Condition} Condition */

/** Streams up to which every subset is read; beyond that only the trained ones and none. */
const MOST_STREAMS = 4;

/**
 * @param {string[]} streams
 * @param {Record<string, CameraState>} cameras
 * @returns {boolean[]} (V) The streams that are present.
 */
export function present(streams, cameras) {
  return streams.map(stream => {
    const switched = cameras[cameraOf(stream)].input;
    return switched === 'both' || switched === modalityOf(stream);
  });
}

/**
 * Whether a policy of these streams gets what a switch is to give.
 * @param {string[]} streams
 * @param {string} camera
 * @param {CameraState['input']} input
 */
export function gives(streams, camera, input) {
  return input === 'off' || input === 'both'
    || streams.some(stream => cameraOf(stream) === camera && modalityOf(stream) === input);
}

/**
 * The shortest name: one word if there is one, otherwise `a+b`.
 * @param {boolean[]} mask
 * @param {string[]} streams
 */
export function nameOf(mask, streams) {
  for (const [word, group] of Object.entries(groups(streams))) {
    if (group.every((on, i) => on === mask[i])) return word;
  }
  /** @type {string[]} */
  const parts = [];
  for (const camera of new Set(streams.map(cameraOf))) {
    const own = streams.filter(stream => cameraOf(stream) === camera);
    const on = own.filter(stream => mask[streams.indexOf(stream)]);
    parts.push(...on.length === own.length ? [camera] : on);
  }
  return parts.join('+');
}

/**
 * The subsets of which a readout says action and Q: the full one first.
 * @param {string[]} streams
 * @param {string[]} trained
 * @returns {{names: string[], masks: boolean[][]}}
 */
export function readSubsets(streams, trained) {
  const count = streams.length;
  if (count > MOST_STREAMS) {
    const table = groups(streams);
    const names = [...trained.filter(name => name in table), 'none'];
    return {names, masks: names.map(name => table[name])};
  }
  const masks = Array.from({length: 2 ** count}, (_, number) =>
    streams.map((_, i) => (number >> (count - 1 - i) & 1) === 0));
  return {names: masks.map(mask => nameOf(mask, streams)), masks};
}

/** @param {string[]} streams @returns {Record<string, boolean[]>} */
function groups(streams) {
  const several = new Set(streams.map(modalityOf)).size > 1;
  /** @type {Record<string, boolean[]>} */
  const table = {all: streams.map(() => true), none: streams.map(() => false)};
  for (const modality of several ? ['rgb', 'depth'] : []) {
    table[modality] = streams.map(stream => modalityOf(stream) === modality);
  }
  for (const camera of new Set(streams.map(cameraOf))) {
    table[camera] = streams.map(stream => cameraOf(stream) === camera);
  }
  for (const stream of streams) table[stream] ??= streams.map(other => other === stream);
  return table;
}

/**
 * What a policy is given, in the words under which the server keeps its results.
 * @param {string[]} streams
 * @param {Record<string, CameraState>} cameras
 * @param {Record<string, Displacement>} moves
 * @returns {Condition}
 */
export function conditionOf(streams, cameras, moves) {
  const mask = present(streams, cameras);
  const seen = new Set(streams.filter((_, i) => mask[i]).map(cameraOf));
  const names = [...seen].sort();
  const failing = names.filter(name => cameras[name].occlusion.kind !== 'none');
  const moved = names.filter(name => name in moves);
  const words = [
    ...failing.map(name => `${name}:${failureKey(cameras[name].occlusion)}`),
    ...moved.map(name => `${name}:${moveKey(moves[name])}`),
  ];
  return {subset: nameOf(mask, streams), occlusions: words.join(';')};
}

/** @param {import('./messages.js').Occlusion} occlusion */
export function failureKey({kind, strength, x, y, width, height}) {
  const sides = width === height ? {size: width} : {width, height};
  const numbers = Object.entries({strength, x, y, ...sides});
  return kind + numbers.map(([name, value]) => `,${name}=${value}`).join('');
}

/** @param {Displacement} move */
function moveKey(move) {
  const plain = {forward: 0, right: 0, up: 0, pan: 0, tilt: 0, zoom: 1};
  const numbers = Object.entries(plain).filter(([name, value]) =>
    move[/** @type {keyof Displacement} */ (name)] !== value);
  return 'moved' + numbers.map(([name]) =>
    `,${name}=${move[/** @type {keyof Displacement} */ (name)]}`).join('');
}
