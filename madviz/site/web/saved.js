/**
 * Saved sessions: the episodes played here as a file, and such files read again.
 *
 * The file has the form of `madviz/session/session_file.py` and says `"made_by": "site"`. Whoever
 * replays it elsewhere compares switches and outcome, since another simulator and another graphics
 * driver give other last bits. Files come from anybody, so everything in them is checked.
 */
import {INPUTS, KINDS, noOcclusion} from './camera_state.js';
import {gives} from './subsets.js';

/** @typedef {import('./messages.js').CameraEvent} CameraEvent */
/** @typedef {import('./messages.js').SitePolicy} SitePolicy */
/** @typedef {import('./simulation.js').Simulation} Simulation */
/**
 * What it takes to play an episode again.
 * @typedef {{policy: string, seed: number, events: CameraEvent[]}} Recipe
 */

const SCHEMA = 1;
/** The name of a policy ends so where a guard watches. */
const GUARDED = ' (guarded)';
/** Characters in a file, at most. */
const LONGEST = 4e6;
const MOST_EVENTS = 10_000;
const MOVES = {forward: 1, right: 1, up: 1, pan: 90, tilt: 90};

/**
 * One episode as a file has it.
 * @param {Simulation} simulation
 * @returns {Promise<object>}
 */
export async function savedEpisode(simulation) {
  const {policy, task, events, started, actions, flags, seed} = simulation;
  const {cameras} = policy.spec;
  const first = events.slice(0, started);
  return {
    policy: savedPolicy(policy.spec, first.some(event => event.guard)),
    task: task.said.name,
    render_profile: 'fast',
    seed,
    cameras,
    start: first.filter(event => event.guard === undefined).map(event => command(event)),
    commands: events.slice(started).map(event => ({step: event.step, ...command(event, policy.spec)})),
    steps: actions.length,
    ended: simulation.ended,
    success: simulation.physics.success,
    success_any: simulation.successAny,
    sha256: {
      actions: await digestOf(new Float32Array(actions.flatMap(action => [...action]))),
      // Rewards are not worked out here.
      rewards: '0'.repeat(64),
      success: await digestOf(Uint8Array.from(flags, Number)),
    },
    trace: '0'.repeat(4 * actions.length),
  };
}

/** The policy under the name that a file has. @param {SitePolicy} spec @param {boolean} guarded */
function savedPolicy({name, digest, guarded_digest}, guarded) {
  return guarded ? {name: name + GUARDED, digest: guarded_digest} : {name, digest};
}

/**
 * The file of several episodes.
 * @param {object[]} episodes
 * @param {Record<string, string>} versions
 */
export function savedSession(episodes, versions) {
  return JSON.stringify({schema: SCHEMA, made_by: 'site', versions, episodes}, null, 1) + '\n';
}

/**
 * An episode of a saved session. Throws an Error, one sentence, for anything amiss.
 * @param {string} text
 * @param {number | undefined} number From 1; by default the last.
 * @param {SitePolicy[]} policies
 * @returns {Recipe}
 */
export function readEpisode(text, number, policies) {
  check(text.length <= LONGEST, 'a file of at most 4 MB');
  let file;
  try {
    file = JSON.parse(text);
  } catch (error) {
    throw new Error('Expected a saved session, found no JSON; save it again.');
  }
  check(file?.schema === SCHEMA && Array.isArray(file.episodes), 'a saved session of schema 1');
  const index = number === undefined ? file.episodes.length - 1 : number - 1;
  const episode = file.episodes[index];
  check(isObject(episode), `an episode from 1 to ${file.episodes.length}`);
  const asked = String(episode.policy?.name).slice(0, 140), guarded = asked.endsWith(GUARDED);
  const policy = policies.find(one => guarded && one.guard ? one.name + GUARDED === asked
    : one.name === asked);
  check(policy !== undefined, `a policy of this site, found ${asked.slice(0, 60)}`);
  const {start, commands, seed} = episode;
  check(Number.isSafeInteger(seed) && seed >= 0, 'a seed');
  check(Array.isArray(start) && Array.isArray(commands), 'a list of commands');
  check(start.length + commands.length <= MOST_EVENTS, 'at most 10,000 commands');
  const spec = /** @type {SitePolicy} */ (policy);
  const events = [
    ...guarded ? [{step: 0, camera: '', guard: true}] : [],
    ...start.map((/** @type {any} */ one) => readCommand({...one, step: 0}, spec)),
    ...commands.map((/** @type {any} */ one) => readCommand(one, spec)),
  ];
  return {policy: spec.name, seed, events};
}

/**
 * @param {any} found
 * @param {SitePolicy} spec
 * @returns {CameraEvent}
 */
function readCommand(found, spec) {
  check(isObject(found), 'a command');
  const {step, camera, input, occlusion, move, policy} = found;
  const cameras = spec.cameras.map(one => one.name), both = [spec.name, spec.name + GUARDED];
  check(Number.isSafeInteger(step) && step >= 0 && step <= MOST_EVENTS, 'a step of each command');
  if (policy !== undefined) { // The same one, with a guard or without.
    check(both.includes(policy), 'one policy from start to end');
    check(policy === spec.name || spec.guard !== undefined, 'a guard that this site has');
    return {step, camera: '', guard: policy !== spec.name};
  }
  check(cameras.includes(camera), `a camera of ${cameras.join(', ')}`);
  if (move !== undefined) return {step, camera, move: move === null ? null : readMove(move)};
  check(INPUTS.includes(input), `an input of ${INPUTS.join(', ')}`);
  check(gives(spec.streams, camera, input), `an input that ${spec.name} gets of ${camera}`);
  if (occlusion === undefined) return {step, camera, state: {input, occlusion: noOcclusion()}};
  check(isObject(occlusion), 'an occlusion');
  const {size} = occlusion;
  const sides = size === undefined ? {} : {width: size, height: size};
  const {kind, strength, x, y, width, height} = {...noOcclusion(), ...occlusion, ...sides};
  check(KINDS.includes(kind), `an occlusion of ${KINDS.join(', ')}`);
  const shares = {strength, x, y, width, height};
  for (const [name, value] of Object.entries(shares)) {
    check(isNumber(value) && value >= 0 && value <= 1, `${name} of an occlusion from 0 to 1`);
  }
  return {step, camera, state: {input, occlusion: {kind, ...shares}}};
}

/** @param {any} found */
function readMove(found) {
  check(isObject(found), 'a move');
  for (const [name, most] of Object.entries(MOVES)) {
    const value = found[name];
    check(isNumber(value) && Math.abs(value) <= most, `${name} of a move within ${most}`);
  }
  check(isNumber(found.zoom) && found.zoom >= 0.5 && found.zoom <= 2, 'a zoom from 0.5 to 2');
  const {forward, right, up, pan, tilt, zoom} = found;
  return {forward, right, up, pan, tilt, zoom};
}

/** @param {any} value */
function isObject(value) {
  return typeof value === 'object' && value !== null && !Array.isArray(value);
}

/** @param {any} value */
function isNumber(value) {
  return typeof value === 'number' && Number.isFinite(value);
}

/**
 * @param {boolean} holds
 * @param {string} expected
 */
function check(holds, expected) {
  if (!holds) throw new Error(`Expected ${expected} in a saved session; save it again.`);
}

/**
 * @param {CameraEvent} event
 * @param {SitePolicy} [spec] The policy that acts; it changes with a guard.
 */
function command({camera, state, move, guard}, spec) {
  if (guard !== undefined && spec) {
    const {name, digest} = savedPolicy(spec, guard);
    return {policy: name, digest};
  }
  if (state === undefined) return {camera, move: move ?? null};
  const {input, occlusion} = state;
  const same = JSON.stringify(occlusion) === JSON.stringify(noOcclusion());
  return {camera, input, ...same ? {} : {occlusion}};
}

/**
 * SHA-256 as 64 digits; zeros where a browser works none out, as on pages without https.
 * @param {Float32Array | Uint8Array} numbers
 */
async function digestOf(numbers) {
  if (!globalThis.crypto?.subtle) return '0'.repeat(64);
  const bytes = new Uint8Array(numbers.buffer, numbers.byteOffset, numbers.byteLength);
  const digest = await crypto.subtle.digest('SHA-256', bytes.slice());
  return Array.from(new Uint8Array(digest), byte => byte.toString(16).padStart(2, '0')).join('');
}
