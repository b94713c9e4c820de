/**
 * Meta-World's simulation on MuJoCo in WebAssembly: start states, decisions, what a policy knows.
 *
 * An action moves a mocap body, to which a weld pulls the hand, by 0.01 m x action; its last number
 * closes the gripper. Two such steps of five simulator steps each are one decision. Python works
 * the way out in 32 bits, and so does this file (`Math.fround`).
 */
import {importSource} from './files.js';
import {Stepping} from './stepping.js';
import {readTensors, rowOf} from './tensors.js';
import {SUCCESS} from './tasks.js';

/** @typedef {import('./messages.js').SiteTask} SiteTask */
/** @typedef {import('./tensors.js').Tensor} Tensor */
/** @typedef {any} MuJoCo The module of `@mujoco/mujoco`. */

const SUBSTEPS = 5;
const METRES = 0.01;
/** Where Meta-World's observation ends for the hand: low and high, metres. */
const HAND = [
  [-0.525, 0.348, -0.0525],
  [0.525, 1.025, 0.7],
];
const STATE = 24;
const MOMENT = 8;

/**
 * @param {Record<'mujoco.js' | 'mujoco.wasm', ArrayBuffer>} files
 * @returns {Promise<MuJoCo>}
 */
export async function startMuJoCo(files) {
  const {default: load} = await importSource(files['mujoco.js']);
  // It is given what it would otherwise look for beside itself.
  return load({wasmBinary: files['mujoco.wasm'], locateFile: (/** @type {string} */ name) => name});
}

export class Physics {
  /**
   * @param {MuJoCo} mujoco
   * @param {SiteTask} task
   * @param {ArrayBuffer} model MJCF text.
   * @param {ArrayBuffer} starts A file of `madviz/site/starts.py`.
   */
  constructor(mujoco, task, model, starts) {
    this.mujoco = mujoco;
    this.task = task;
    this.model = mujoco.MjModel.from_xml_string(new TextDecoder().decode(model));
    this.data = new mujoco.MjData(this.model);
    this.stepping = new Stepping(mujoco, this.model, this.data);
    /** @type {Record<string, Tensor>} */
    this.starts = readTensors(starts).tensors;
    this.seeds = Array.from(this.starts.seeds.data);
    this.step = 0;
    this.success = false;
    this.lifted = 0;
    this.gripper = 0;
    this.state = new Float32Array(STATE);
    this.target = new Float64Array(3);
    /** What the hand's half of an observation was a simulator step ago. */
    this.before = new Float64Array(4);
    /** @type {Map<string, number>} */
    this.numbers = new Map();
  }

  /**
   * Throws an Error for a seed whose start state is not shipped.
   * @param {number} seed
   */
  check(seed) {
    if (this.seeds.includes(seed)) return;
    const [first, last] = [this.seeds[0], this.seeds[this.seeds.length - 1]];
    throw new Error(`This site has the seeds from ${first} to ${last}, and no ${seed}.`);
  }

  /**
   * Begins the episode of a seed.
   * @param {number} seed
   */
  begin(seed) {
    this.check(seed);
    const row = this.seeds.indexOf(seed);
    const {mujoco, model, data} = this;
    mujoco.mj_resetData(model, data);
    for (const name of ['body_pos', 'site_pos']) model[name].set(rowOf(this.starts[name], row));
    for (const name of ['qpos', 'qvel', 'ctrl', 'mocap_pos', 'mocap_quat', 'qacc_warmstart']) {
      data[name].set(rowOf(this.starts[name], row));
    }
    this.stepping.forward();
    this.step = 0;
    this.success = rowOf(this.starts.success, row)[0] !== 0;
    this.lifted = rowOf(this.starts.lifted, row)[0];
    this.target.set(rowOf(this.starts.target, row));
    this.state.set(rowOf(this.starts.state, row));
    this.before.set(this.hand());
  }

  /**
   * One decision.
   * @param {Float32Array} action (4) in [-1, 1].
   */
  act(action) {
    const {data} = this;
    const clipped = action.map(value => Math.min(Math.max(value, -1), 1));
    for (let repeat = 0; repeat < this.task.action_repeat; repeat++) {
      this.before.set(this.hand());
      const place = data.mocap_pos;
      for (let axis = 0; axis < 3; axis++) {
        const way = place[axis] + Math.fround(clipped[axis] * Math.fround(METRES));
        place[axis] = Math.min(Math.max(way, this.task.reach[0][axis]), this.task.reach[1][axis]);
      }
      data.mocap_quat.set([1, 0, 1, 0]);
      data.ctrl.set([clipped[3], -clipped[3]]);
      for (let n = 0; n < SUBSTEPS; n++) this.stepping.step();
      this.stepping.forward();
    }
    this.step += 1;
    this.observe();
    this.success = SUCCESS[this.task.name](this, this.target);
  }

  /** Puts the newest eight numbers behind those of the two decisions before. */
  observe() {
    const now = this.hand();
    this.gripper = now[3];
    this.state.copyWithin(0, MOMENT);
    this.state.set([...now, ...this.before], STATE - MOMENT);
  }

  /** Hand in metres and how far the gripper is open, as Meta-World observes them. */
  hand() {
    const place = this.body('hand');
    const [right, left] = [this.body('rightclaw'), this.body('leftclaw')];
    const apart = Math.hypot(right[0] - left[0], right[1] - left[1], right[2] - left[2]);
    const inside = (/** @type {number} */ axis) =>
      Math.min(Math.max(place[axis], HAND[0][axis]), HAND[1][axis]);
    return [inside(0), inside(1), inside(2), Math.min(apart / 0.1, 1)];
  }

  /** The middle between the fingertips, metres. */
  fingertips() {
    const [right, left] = [this.site('rightEndEffector'), this.site('leftEndEffector')];
    return [0, 1, 2].map(axis => (right[axis] + left[axis]) / 2);
  }

  /** @param {string} name @returns {Float64Array} */
  body(name) {
    return at(this.data.xpos, this.number('mjOBJ_BODY', name), 3);
  }

  /** @param {string} name @returns {Float64Array} */
  site(name) {
    return at(this.data.site_xpos, this.number('mjOBJ_SITE', name), 3);
  }

  /** @param {string} name @returns {Float64Array} */
  geom(name) {
    return at(this.data.geom_xpos, this.number('mjOBJ_GEOM', name), 3);
  }

  /** @param {string} name Of a joint with one number. */
  joint(name) {
    return this.data.qpos[this.model.jnt_qposadr[this.number('mjOBJ_JOINT', name)]];
  }

  /** Whether both pads of the gripper press on the object. */
  pinched() {
    const object = this.number('mjOBJ_GEOM', 'objGeom');
    const pressed = ['leftpad_geom', 'rightpad_geom'].map(name =>
      this.pressure(this.number('mjOBJ_GEOM', name), object),
    );
    return pressed.every(force => force > 0);
  }

  /**
   * The sum of the normal forces between two shapes, newtons.
   * @param {number} a
   * @param {number} b
   */
  pressure(a, b) {
    const contacts = this.data.contact;
    let sum = 0;
    for (let i = 0; i < this.data.ncon; i++) {
      const contact = contacts.get(i);
      const pair = [contact.geom1, contact.geom2];
      if (pair.includes(a) && pair.includes(b))
        sum += this.data.efc_force[contact.efc_address] ?? 0;
      contact.delete?.();
    }
    contacts.delete?.();
    return sum;
  }

  /**
   * @param {string} kind
   * @param {string} name
   */
  number(kind, name) {
    const key = `${kind} ${name}`;
    const known = this.numbers.get(key);
    if (known !== undefined) return known;
    const found = this.mujoco.mj_name2id(this.model, this.mujoco.mjtObj[kind].value, name);
    if (found < 0) throw new Error(`${this.task.name} has no ${name}`);
    this.numbers.set(key, found);
    return found;
  }

  /** Frees what WebAssembly holds. */
  close() {
    this.data.delete();
    this.model.delete();
  }
}

/**
 * @param {Float64Array} numbers
 * @param {number} index
 * @param {number} width
 */
function at(numbers, index, width) {
  return numbers.subarray(width * index, width * (index + 1));
}
