/**
 * Every state of the page as a link, and back.
 *
 *     #policy=metaworld-hammer-mad-light&vs=metaworld-hammer-merged-only-light&seed=5003
 *      &first=off@15&third_a=noise:0.5@10-18&b.third_b=patch:1:0.3:0.5:0.4:0.2@40
 *
 *     guard=on[@from[-to]]      a camera that fails is left out; guard=off[@from]: no more
 *     camera=what[@from[-to]]   as `madviz eval --occlude` and `madviz record --drop` have it
 *     a.camera=…, b.camera=…    one side of a comparison; without it, both
 *
 *     what   off, on, rgb, depth          the switch; off leaves the sum
 *            black, noise:0.5, freeze,    the camera stays in the sum and sends a broken picture
 *            blur:0.5, patch:strength:x:y:width:height
 *            depth:noise:0.5              a switch and a failure
 *            move:forward:right:up:pan:tilt:zoom, home
 *
 * Links come from chats, which cut and change them; so nothing here throws. What cannot be read is
 * left out, and a sentence says so.
 */

import {INPUTS, KINDS, intact} from './camera_state.js';

/** @typedef {import('./messages.js').CameraEvent} CameraEvent */
/** @typedef {import('./messages.js').CameraState} CameraState */
/** @typedef {import('./messages.js').Displacement} Displacement */
/** @typedef {import('./messages.js').Side} Side */
/**
 * A camera is set, or it is moved, or a guard begins or ends to watch; from `step` on.
 * @typedef {import('./messages.js').ScheduledEvent} LinkEvent
 */
/**
 * @typedef {object} LinkState
 * @property {string | null} policy
 * @property {string | null} vs The policy of side B.
 * @property {number | null} seed
 * @property {LinkEvent[]} events In the order of their steps.
 */

const LONGEST = 8000, MOST_EVENTS = 200, LAST_STEP = 9999, LAST_SEED = 2 ** 31 - 1;
/** @type {[keyof Displacement, number, number][]} */
const AXES = [
  ['forward', -1, 1], ['right', -1, 1], ['up', -1, 1],
  ['pan', -90, 90], ['tilt', -90, 90], ['zoom', 0.5, 2],
];
const SIDES = /** @type {Record<string, Side>} */ ({a: 'first', b: 'second'});
const GUARD = 'guard';
const EXAMPLE = 'for example third_a=off@20';

/**
 * @param {string} hash With or without its `#`.
 * @returns {{state: LinkState, problems: string[]}} A problem is one sentence.
 */
export function parseLink(hash) {
  /** @type {LinkState} */
  const state = {policy: null, vs: null, seed: null, events: []};
  /** @type {string[]} */
  const problems = [];
  const text = String(hash).replace(/^#/, '');
  if (text.length > LONGEST) {
    return {state, problems: [`The link has more than ${LONGEST} characters, so it was not read.`]};
  }
  for (const part of text.split('&')) {
    if (part === '') continue;
    const problem = readPart(part, state);
    if (problem) problems.push(problem);
  }
  if (state.events.length > MOST_EVENTS) {
    problems.push(`The link has more than ${MOST_EVENTS} switches; the first ones are used.`);
    state.events.length = MOST_EVENTS;
  }
  state.events.sort((one, other) => one.step - other.step); // Stable: order within a step stays.
  return {state, problems};
}

/**
 * @param {string} part `key=value`.
 * @param {LinkState} state Gets what is found.
 * @returns {string} A problem, or ''.
 */
function readPart(part, state) {
  const shown = part.length > 40 ? `${part.slice(0, 40)}…` : part;
  let text;
  try {
    text = decodeURIComponent(part);
  } catch {
    return `The link's “${shown}” cannot be decoded, so it was left out.`;
  }
  const [, key, value] = /^([^=]*)=?([^]*)$/.exec(text) ?? ['', '', ''];
  if (key === 'policy' || key === 'vs') {
    if (!/^[A-Za-z0-9][A-Za-z0-9._-]{0,119}$/.test(value)) {
      return `The link's “${shown}” names no policy, so it was left out.`;
    }
    state[key] = value;
    return '';
  }
  if (key === 'seed') {
    if (!/^\d{1,10}$/.test(value) || Number(value) > LAST_SEED) {
      return `The link's “${shown}” is no seed, so it was left out.`;
    }
    state.seed = Number(value);
    return '';
  }
  const events = readEvents(key, value);
  if (!events) return `The link's “${shown}” cannot be read (${EXAMPLE}), so it was left out.`;
  state.events.push(...events);
  return '';
}

/**
 * @param {string} key `third_a` or `b.third_a`.
 * @param {string} value `noise:0.5@10-18`.
 * @returns {LinkEvent[] | null}
 */
function readEvents(key, value) {
  const who = /^(?:([ab])\.)?([a-z][a-z0-9_]{0,23})$/.exec(key);
  const how = /^([a-z0-9.:-]+?)(?:@(\d{1,4})(?:-(\d{1,4}))?)?$/.exec(value);
  if (!who || !how) return null;
  const side = who[1] ? SIDES[who[1]] : /** @type {Side} */ ('both'), camera = who[2];
  const step = Number(how[2] ?? 0), end = how[3] === undefined ? null : Number(how[3]);
  const what = key === GUARD ? readGuard(how[1]) : readWhat(how[1]);
  if (!what || step > LAST_STEP || (end !== null && end <= step)) return null;
  const named = key === GUARD ? '' : camera;
  /** @type {LinkEvent[]} */
  const events = [{step, side, camera: named, ...what}];
  if (end !== null) {
    const back = 'guard' in what ? {guard: !what.guard}
      : 'move' in what ? {move: null} : {state: intact()};
    events.push({step: end, side, camera: named, ...back});
  }
  return events;
}

/** @param {string} text @returns {{guard: boolean} | null} */
function readGuard(text) {
  return ['on', 'off'].includes(text) ? {guard: text === 'on'} : null;
}

/**
 * @param {string} text
 * @returns {{state: CameraState} | {move: Displacement | null} | null}
 */
function readWhat(text) {
  const words = text.split(':');
  if (words[0] === 'home') return words.length === 1 ? {move: null} : null;
  if (words[0] === 'move') return readMove(words.slice(1));
  const state = intact();
  if (words[0] === 'on') words[0] = 'both';
  if (INPUTS.includes(words[0])) {
    state.input = /** @type {CameraState['input']} */ (words.shift());
  }
  if (words.length === 0) return {state};
  const kind = /** @type {string} */ (words.shift()), most = kind === 'patch' ? 5 : 1;
  if (!KINDS.includes(kind) || ![0, 1, most].includes(words.length)) return null;
  state.occlusion.kind = /** @type {CameraState['occlusion']['kind']} */ (kind);
  const names = /** @type {const} */ (['strength', 'x', 'y', 'width', 'height']);
  for (const [index, word] of words.entries()) {
    const value = number(word, 0, 1);
    if (value === null) return null;
    state.occlusion[names[index]] = value;
  }
  return {state};
}

/**
 * @param {string[]} words
 * @returns {{move: Displacement} | null}
 */
function readMove(words) {
  if (words.length !== AXES.length) return null;
  const move = {forward: 0, right: 0, up: 0, pan: 0, tilt: 0, zoom: 1};
  for (const [index, [name, least, most]] of AXES.entries()) {
    const value = number(words[index], least, most);
    if (value === null) return null;
    move[name] = value;
  }
  return {move};
}

/**
 * @param {string} word
 * @param {number} least
 * @param {number} most
 * @returns {number | null}
 */
function number(word, least, most) {
  if (!/^-?(\d{1,3}(\.\d{0,6})?|\.\d{1,6})$/.test(word)) return null;
  const value = Number(word);
  return value >= least && value <= most ? Number(brief(value)) : null;
}

/**
 * The way back. Numbers have three digits after the point, which is finer than a slider.
 * @param {LinkState} state
 * @returns {string} With its `#`.
 */
export function formatLink(state) {
  const parts = [];
  if (state.policy) parts.push(`policy=${encodeURIComponent(state.policy)}`);
  if (state.vs) parts.push(`vs=${encodeURIComponent(state.vs)}`);
  if (state.seed !== null) parts.push(`seed=${state.seed}`);
  for (const event of state.events.slice(0, MOST_EVENTS)) {
    const prefix = {first: 'a.', second: 'b.', both: ''}[event.side];
    const at = event.step ? `@${event.step}` : '';
    parts.push(`${prefix}${event.camera || GUARD}=${whatText(event)}${at}`);
  }
  return `#${parts.join('&')}`;
}

/** @param {CameraEvent} event */
function whatText({state, move, guard}) {
  if (guard !== undefined) return guard ? 'on' : 'off';
  return state ? stateText(state) : moveText(move ?? null);
}

/** @param {CameraState} state */
function stateText({input, occlusion}) {
  const failure = occlusion.kind === 'none' ? '' : occlusionText(occlusion);
  if (input === 'both') return failure || 'on';
  return failure ? `${input}:${failure}` : input;
}

/** @param {CameraState['occlusion']} occlusion */
function occlusionText(occlusion) {
  const {kind, strength, x, y, width, height} = occlusion;
  if (kind === 'patch') return ['patch', ...[strength, x, y, width, height].map(brief)].join(':');
  return strength === 1 ? kind : `${kind}:${brief(strength)}`;
}

/** @param {Displacement | null} move */
function moveText(move) {
  return move ? ['move', ...AXES.map(([name]) => brief(move[name]))].join(':') : 'home';
}

/** The guard is switched on both sides, also where one of them has none. @param {CameraEvent} event */
function isGuard(event) {
  return event.guard !== undefined;
}

/** Three digits after the point, and no -0. @param {number} value */
function brief(value) {
  return String(Math.round(value * 1000) / 1000 || 0);
}

/**
 * The journals of both sides as one: what is the same on both is said once.
 * @param {CameraEvent[]} first
 * @param {CameraEvent[] | null} second
 * @returns {LinkEvent[]}
 */
export function mergedEvents(first, second) {
  const keyOf = (/** @type {CameraEvent} */ event) =>
    JSON.stringify([event.step, event.camera, whatText(event)]);
  const others = new Map((second ?? []).map(event => [keyOf(event), event]));
  /** @type {LinkEvent[]} */
  const events = [];
  for (const event of first) {
    const same = others.delete(keyOf(event)) || second === null;
    events.push({...event, side: same || isGuard(event) ? 'both' : 'first'});
  }
  for (const event of others.values()) {
    events.push({...event, side: isGuard(event) ? 'both' : 'second'});
  }
  events.sort((one, other) => one.step - other.step);
  // That a camera works at the first step is said only where it was off or broken there before.
  return events.filter(({step, camera, state}, i) => step > 0 || !state || stateText(state) !== 'on'
    || events.slice(0, i).some(one => one.camera === camera && one.state && stateText(one.state) !== 'on'));
}
