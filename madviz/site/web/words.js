/**
 * What happened, in words: subsets, failures, changes and outcomes as a visitor reads them.
 *
 * Plain functions from frames to text, the same sentences as `madviz/session/frame.py` has.
 */

import {noOcclusion} from './camera_state.js';
import {failureKey} from './subsets.js';

/** @typedef {import('./messages.js').CameraSpec} CameraSpec */
/** @typedef {import('./messages.js').CameraState} CameraState */
/** @typedef {import('./messages.js').Displacement} Displacement */
/** @typedef {import('./messages.js').World} World */

/**
 * @param {string} name
 * @param {CameraSpec[]} cameras
 */
export function labelOf(name, cameras) {
  return cameras.find(camera => camera.name === name)?.label ?? name;
}

/**
 * @param {string} subset `first+third_a`, `first.depth`, `all`, `none`.
 * @param {CameraSpec[]} cameras
 * @returns {string} `First person + Third A`.
 */
export function subsetWords(subset, cameras) {
  if (subset === 'all') return 'all cameras';
  if (subset === 'none') return 'no camera';
  if (subset === 'rgb') return 'colour of all cameras';
  if (subset === 'depth') return 'depth of all cameras';
  return subset.split('+').map(part => {
    const [camera, modality] = part.split('.');
    const label = labelOf(camera, cameras);
    return modality ? `${label} ${modality === 'rgb' ? 'colour' : 'depth'}` : label;
  }).join(' + ');
}

/**
 * @param {import('./messages.js').Condition} condition
 * @param {CameraSpec[]} cameras
 * @returns {string} `with guard · all cameras · first:noise strength=0.5`; numbers that are as they
 *   begin are left out.
 */
export function conditionWords({subset, occlusions, guarded}, cameras) {
  const plain = failureKey(noOcclusion()).split(',');
  const failures = occlusions.split(';').map(one =>
    one.split(',').filter(word => !plain.includes(word)).join(' ')).join(', ');
  return [guarded ? 'with guard' : '', subsetWords(subset, cameras), failures].filter(Boolean)
    .join(' · ');
}

const HOME = 'is back in its place';
const NOTICED = {fine: '', gone: 'sends nothing', black: 'sends black', covered: 'is covered',
  noise: 'sends noise', blurred: 'is blurred', frozen: 'is frozen', lossy: 'loses pictures',
  late: 'is late'};

/** @param {import('./messages.js').Noticed} noticed @returns {string} `LATE · left out since step 23`. */
export function badgeWords({kind, since}) {
  return `${kind.toUpperCase()} · left out since step ${since}`;
}

/**
 * All that the guard says of a step; '' where no camera fails. The same as
 * `madviz/session/guard_words.py`.
 * @param {World} world
 * @param {CameraSpec[]} cameras
 */
export function guardWords({guard, mask}, cameras) {
  if (!guard?.length) return '';
  const words = guard.map(({camera, kind, since, why}) =>
    `${labelOf(camera, cameras)} ${NOTICED[kind]} since step ${since} (${why}): left out.`);
  const rest = mask.some(Boolean) ? '' : ' No camera is left: the policy acts on the state alone.';
  return `Guard: ${words.join(' ')}${rest}`;
}

/**
 * What stands in a picture's corner; '' where all is well.
 * @param {CameraState | undefined} state
 * @param {Displacement | undefined} move
 */
export function tagWords(state, move) {
  if (state?.input === 'off') return 'off';
  const words = [];
  if (state && state.occlusion.kind !== 'none') {
    words.push({black: 'black', noise: 'noise', freeze: 'frozen', blur: 'blurred',
      patch: 'patch'}[state.occlusion.kind]);
  }
  if (move) words.push('moved');
  return words.join(', ');
}

/**
 * @param {CameraState} state
 * @returns {string} A predicate: `sends black`.
 */
export function stateWords({input, occlusion}) {
  if (input === 'off') return 'is off';
  const share = `${Math.round(100 * occlusion.strength)} %`;
  const failure = {none: '', black: 'sends black', noise: `sends ${share} noise`,
    freeze: 'is frozen', blur: `is blurred by ${share}`, patch: 'has a patch in view',
  }[occlusion.kind];
  if (failure) return failure;
  return {rgb: 'sends colour', depth: 'sends depth', both: 'sends its picture'}[input];
}

/** @param {Displacement} move */
export function moveWords(move) {
  /** @type {[keyof Displacement, string, string, string][]} */
  const axes = [['forward', 'forward', 'back', ' m'], ['right', 'to the right', 'to the left', ' m'],
    ['up', 'up', 'down', ' m'], ['pan', 'right', 'left', '°'], ['tilt', 'up', 'down', '°']];
  const words = [];
  for (const [name, ahead, back, unit] of axes) {
    const value = move[name], size = Math.abs(value);
    if (!value) continue;
    const word = value > 0 ? ahead : back;
    words.push(unit === '°' ? `turned ${word} ${size.toFixed(0)}°` : `${size.toFixed(2)} m ${word}`);
  }
  if (move.zoom !== 1) {
    words.push(`zoomed ${move.zoom > 1 ? 'in' : 'out'} to ${move.zoom.toFixed(2)}`);
  }
  return words.join(', ') || 'in its place';
}

/**
 * @param {NonNullable<World['change']>} change
 * @param {CameraSpec[]} cameras
 * @returns {string} `Third A is off: action changed by 0.31, Q 12.1 → 9.8`.
 */
export function changeWords(change, cameras) {
  const label = labelOf(change.camera, cameras);
  const back = change.before.input === 'off' && change.after.input !== 'off'
    && change.after.occlusion.kind === 'none';
  const place = change.home ? HOME : 'has another place';
  const deed = change.moved ? place : back ? 'is back' : stateWords(change.after);
  return `${label} ${deed}: ${effectWords(change)}`;
}

/**
 * @param {import('./messages.js').CameraEvent} event
 * @param {CameraSpec[]} cameras
 * @returns {string} `Third A is off`, for the mark of a step.
 */
export function eventWords({camera, state, move, guard}, cameras) {
  if (guard !== undefined) return `guard ${guard ? 'on' : 'off'}`;
  return `${labelOf(camera, cameras)} ${state ? stateWords(state) : move ? 'moved' : HOME}`;
}

/** @param {NonNullable<World['change']>} change */
export function effectWords(change) {
  if (!Number.isFinite(change.action_change)) {
    return `this policy ${Number.isFinite(change.q_after) ? 'can act again' : 'cannot act on that'}`;
  }
  const action = `action changed by ${change.action_change.toFixed(2)}`;
  if (!Number.isFinite(change.q_before) || !Number.isFinite(change.q_after)) return action;
  return `${action}, Q ${change.q_before.toFixed(1)} → ${change.q_after.toFixed(1)}`;
}

/**
 * How an episode stands. The sign says the same as the colour.
 * @param {World} world
 * @returns {{kind: 'good' | 'bad' | 'open', text: string}}
 */
export function outcomeWords(world) {
  if (!world.ended) {
    return {kind: 'open', text: world.success ? 'goal met now' : 'working'};
  }
  if (world.success) return {kind: 'good', text: '✓ success'};
  return {kind: 'bad', text: world.success_any ? '✕ failed (goal met, then lost)' : '✕ failed'};
}

/** @param {number} bytes */
export function megabytes(bytes) {
  return `${(bytes / 1e6).toFixed(1)} MB`;
}
