/**
 * One policy in one simulation, with cameras that can fail at any moment; no clock and no page.
 *
 * What an episode does depends on its seed and on which switch came at which step, on nothing else.
 * A camera that is switched at step t counts from the decision that is taken at step t on.
 */
import {intact} from './camera_state.js';
import {cameraPose, eyes} from './cameras.js';
import {Guard} from './guard.js';
import {shapePoses} from './scene.js';
import {StreamStack, cameraOf} from './streams.js';
import {conditionOf, present, readSubsets} from './subsets.js';

/** @typedef {import('./messages.js').CameraState} CameraState */
/** @typedef {import('./messages.js').CameraEvent} CameraEvent */
/** @typedef {import('./messages.js').Displacement} Displacement */
/** @typedef {import('./messages.js').Outcome} Outcome */
/** @typedef {import('./messages.js').World} World */
/** @typedef {import('./messages.js').Readout} Readout */
/** @typedef {import('./physics.js').Physics} Physics */
/** @typedef {import('./drawing.js').Drawing} Drawing */
/** @typedef {import('./policy.js').Policy} Policy */
/** @typedef {import('./stock.js').Task} Task */

const SIZE = 84;

export class Simulation {
  /**
   * @param {Task} task
   * @param {Physics} physics
   * @param {Drawing} drawing
   * @param {Policy} policy
   */
  constructor(task, physics, drawing, policy) {
    this.task = task;
    this.physics = physics;
    this.drawing = drawing;
    this.policy = policy;
    /** @type {Record<string, CameraState>} */
    this.cameras = {};
    /** @type {Record<string, Displacement>} */
    this.moves = {};
    for (const camera of policy.spec.cameras) this.cameras[camera.name] = intact();
    this.stack = new StreamStack(policy.spec.streams);
    /** What the policy makes of the newest pictures. @type {import('./policy.js').Reading} */
    this.reading = {features: new Float32Array(), merged: new Float32Array(),
      action: new Float32Array(), q: new Float32Array()};
    /** @type {Float32Array} */
    this.poses = new Float32Array();
    /** @type {Record<string, import('./messages.js').Picture>} */
    this.views = {};
    /** What was done to cameras, in order; the first `started` are how the episode began.
     * @type {CameraEvent[]} */
    this.events = [];
    this.started = 0;
    /** @type {Float32Array[]} */
    this.actions = [];
    /** @type {boolean[]} */
    this.flags = [];
    /** The middle between the fingertips at each step, metres. @type {number[][]} */
    this.hands = [];
    /** The first decision that was not taken with all cameras as in training.
     * @type {number | null} */
    this.changedAt = null;
    /** @type {import('./messages.js').HandPaths | null} */
    this.paths = null;
    /** @type {Set<string>} */
    this.conditions = new Set();
    /** That of the last decision. @type {import('./messages.js').Condition | undefined} */
    this.decided = undefined;
    /** @type {import('./messages.js').Change | null} */
    this.change = null;
    /** @type {Readout | null} */
    this.readout = null;
    /** @type {import('./messages.js').Noticed[]} */
    this.noticed = [];
    /** Before it has seen the newest pictures, and after. @type {Guard | null} */
    this.guardBefore = null;
    /** @type {Guard | null} */
    this.guard = null;
    this.guardBegan = this.episode = this.seed = 0;
    this.successAny = false;
  }

  get step() {
    return this.physics.step;
  }

  get ended() {
    return this.step >= this.task.said.horizon;
  }

  /** Whether there is anything to show yet. */
  get begun() {
    return this.reading.q.length > 0;
  }

  /** What the policy does next. */
  get action() {
    return this.reading.action;
  }

  /**
   * Starts the episode of a seed; switches stay.
   * @param {number} seed
   * @param {CameraEvent[]} first What a schedule does at step 0.
   */
  async begin(seed, first) {
    this.physics.begin(seed);
    this.seed = seed;
    this.episode += 1;
    this.successAny = this.physics.success;
    this.change = this.readout = null;
    this.actions = [];
    this.flags = [];
    this.hands = [];
    this.changedAt = this.paths = null;
    this.conditions.clear();
    this.decided = undefined;
    this.watch(this.guard !== null);
    for (const event of first) this.apply(event);
    this.events = Object.entries(this.cameras)
      .filter(([, state]) => JSON.stringify(state) !== JSON.stringify(intact()))
      .map(([camera, state]) => ({step: 0, camera, state}));
    for (const [camera, move] of Object.entries(this.moves)) {
      this.events.push({step: 0, camera, move});
    }
    if (this.guard) this.events.push({step: 0, camera: '', guard: true});
    this.started = this.events.length;
    await this.arrive();
  }

  /** A guard begins to watch, or ends, where the policy has one. @param {boolean} on */
  watch(on) {
    const {guard} = this.policy;
    this.guardBefore = this.guard = on && guard ? new Guard(guard) : null;
    this.guardBegan = this.step;
  }

  /**
   * What a schedule names is as it was before, when an episode begins: cameras are whole, and no
   * guard watches.
   * @param {import('./messages.js').ScheduledEvent[]} schedule
   */
  restore(schedule) {
    if (schedule.some(one => one.guard !== undefined)) this.watch(false);
    for (const {camera: name} of schedule.filter(one => one.camera)) {
      this.cameras[name] = intact();
      delete this.moves[name];
    }
  }

  /** One decision. */
  async advance() {
    const {subset, occlusions, guarded} = this.decided = this.condition();
    if (subset !== 'all' || occlusions) this.changedAt ??= this.step;
    this.conditions.add(JSON.stringify([this.policy.spec.name, subset, occlusions, guarded]));
    this.actions.push(this.action);
    this.physics.act(this.action);
    this.flags.push(this.physics.success);
    this.successAny ||= this.physics.success;
    await this.arrive();
  }

  /**
   * A decision of an earlier episode.
   * @param {Float32Array} action
   * @param {boolean} drawn Whether its pictures are wanted.
   */
  async repeat(action, drawn) {
    this.physics.act(action);
    if (drawn) await this.arrive(); else this.hands.push(this.physics.fingertips());
  }

  /** Draws every camera, and reads the policy on what comes of it. */
  async arrive() {
    this.hands.push(this.physics.fingertips());
    this.stack.push(await this.draw(), this.occlusions(), {seed: this.seed, step: this.step});
    this.guardBefore = this.guard;
    await this.read();
  }

  async draw() {
    this.poses = shapePoses(this.task.scene, this.physics.data);
    const {cameras} = this.policy.spec;
    const from = eyes(cameras, this.moves, this.physics);
    const drawn = await this.drawing.views(this.task.scene, this.poses, from, SIZE);
    this.views = Object.fromEntries(cameras.map((camera, i) => [camera.name, drawn[i]]));
    return this.views;
  }

  /** What the policy makes of the newest pictures; the guard has looked at them, once. */
  async read() {
    this.noticed = this.guardBefore ? this.look(this.guardBefore.copy()) : [];
    this.reading = await this.policy.read(this.stack.views(), this.physics.state, [this.mask()]);
  }

  /** The cameras that fail: each with all its streams. @param {Guard} guard */
  look(guard) {
    const {streams} = this.policy.spec, here = present(streams, this.cameras);
    const pictures = Object.fromEntries(Object.entries(this.stack.newest())
      .filter(([stream]) => here[streams.indexOf(stream)]));
    this.guard = guard;
    const failing = Object.entries(guard.step(pictures, this.physics.state))
      .flatMap(([stream, {kind, since, why}]) => since === null ? []
        : [{camera: cameraOf(stream), kind, since: since + this.guardBegan, why}]);
    return failing.filter((one, i) => i === failing.findIndex(({camera}) => camera === one.camera));
  }

  /** Action and Q of all subsets, at this step. */
  async readAll() {
    const {streams, trained_subsets} = this.policy.spec;
    const {names, masks} = readSubsets(streams, trained_subsets);
    const {action, q} = await this.policy.read(this.stack.views(), this.physics.state, masks);
    this.readout = {step: this.step, subsets: names, action, q};
  }

  /**
   * A guard begins to watch or ends, where it did not already.
   * @param {boolean} on
   */
  async setGuard(on) {
    if ((this.guard !== null) === (on && this.policy.guard !== null)) return;
    this.watch(on);
    await this.read();
    const before = this.events.filter((one, i) =>
      i < this.started || one.step !== this.step || one.guard === undefined);
    this.events = [...before, {step: this.step, camera: '', guard: on}];
    this.readout = null;
  }

  /**
   * Something happens to a camera, and is seen at once.
   * @param {{camera: string, state?: CameraState, move?: Displacement | null, guard?: boolean}} event
   */
  async set(event) {
    if (event.guard !== undefined) return this.setGuard(event.guard);
    const {camera} = event;
    const before = this.cameras[camera];
    const old = this.reading;
    const note = this.apply(event);
    if (event.state) this.stack.replaceLast(this.occlusions());
    else this.stack.replaceViews(await this.draw(), this.occlusions());
    await this.read();
    // Of several in one step the last one counts, for this camera: it is what a decision saw.
    this.events = this.events.filter((one, i) => i < this.started || one.step !== this.step
      || one.camera !== camera || !one.state !== !event.state);
    this.events.push({step: this.step, ...note});
    this.readout = null;
    this.change = {
      camera,
      before,
      after: this.cameras[camera],
      moved: !event.state,
      home: !event.state && !event.move,
      step: this.step,
      action_change: Math.hypot(...this.action.map((value, i) => value - old.action[i])),
      q_before: old.q[0],
      q_after: this.reading.q[0],
    };
  }

  /**
   * @param {{camera: string, state?: CameraState, move?: Displacement | null, guard?: boolean}} event
   * @returns {{camera: string, state?: CameraState, move?: Displacement | null, guard?: boolean}}
   */
  apply({camera, state, move, guard}) {
    if (guard !== undefined) {
      this.watch(guard);
      return {camera, guard};
    }
    if (!(camera in this.cameras)) {
      const known = Object.keys(this.cameras).join(', ');
      throw new Error(`expected a camera of ${known}, found ${camera.slice(0, 40)}`);
    }
    if (state) {
      this.cameras[camera] = state;
      return {camera, state};
    }
    if (move) this.moves[camera] = move;
    else delete this.moves[camera];
    return {camera, move: move ?? null};
  }

  mask() {
    const {streams} = this.policy.spec, failing = this.noticed.map(one => one.camera);
    return present(streams, this.cameras).map((on, i) => on && !failing.includes(cameraOf(streams[i])));
  }

  condition() {
    const condition = conditionOf(this.policy.spec.streams, this.cameras, this.moves);
    return {...condition, guarded: this.guard !== null};
  }

  occlusions() {
    return Object.fromEntries(
      Object.entries(this.cameras).map(([name, state]) => [name, state.occlusion]));
  }

  /** @param {'first' | 'second'} side @returns {Outcome} */
  outcome(side) {
    const [only] = this.conditions;
    const [, subset, occlusions, guarded] = JSON.parse(only ?? '["", "", "", false]');
    const condition = this.conditions.size === 1 ? {subset, occlusions, guarded} : null;
    return {side, policy: this.policy.spec.name, seed: this.seed, condition,
      success: this.physics.success, success_any: this.successAny};
  }

  /** @returns {World} */
  world() {
    const {streams, cameras} = this.policy.spec;
    const {features, merged, action, q} = this.reading;
    const size = features.length / streams.length;
    const norms = streams.map((_, i) =>
      Math.hypot(...features.subarray(i * size, (i + 1) * size)));
    const poses = cameras.map(camera =>
      [camera.name, cameraPose(camera, this.moves[camera.name], this.physics)]);
    return {
      policy: this.policy.spec.name,
      task: this.task.said.name,
      episode: this.episode,
      seed: this.seed,
      step: this.step,
      horizon: this.task.said.horizon,
      cameras: structuredClone(this.cameras),
      moves: structuredClone(this.moves),
      condition: this.condition(),
      decided: this.decided,
      arrived: this.stack.newest(),
      poses: Object.fromEntries(poses),
      geom_poses: this.poses.slice(),
      norms: Float32Array.from(norms),
      streams,
      mask: this.mask(),
      guard: this.guard && structuredClone(this.noticed),
      merged: merged.slice(),
      action: action.slice(),
      q: q[0],
      readout: this.readout && structuredClone(this.readout),
      success: this.physics.success,
      success_any: this.successAny,
      ended: this.ended,
      change: this.change,
      events: structuredClone(this.events),
      paths: structuredClone(this.paths),
    };
  }
}
