/**
 * Steps of a later MuJoCo that end where the version of the policies, 3.3.0, ends.
 *
 * A policy has learned how firmly a grip holds, so a later version that is more right is wrong here.
 * What 3.3.0 did differently, each undone below:
 *
 * - Two boxes that meet with a face of one of them were given half of the depth by which they are in
 *   each other, but the whole depth where two edges meet. Grips are boxes that press on a box.
 * - A weld's reference acceleration had no term for how its Jacobian changes with time. The weld that
 *   pulls the hand then lags by another millimetre.
 * - Shapes had one contact for each pair unless they were boxes, and there were no islands.
 * - Positions worked out anew left the solver's last result where the next step starts from.
 *
 * MuJoCo from 3.12 on finds other contacts of two boxes (a face where 3.3.0 had two edges), which
 * nothing here can undo: `package.json` names the newest version before that.
 */

/** @typedef {any} MuJoCo The module of `@mujoco/mujoco`. */

const LATER = ['mjDSBL_MULTICCD', 'mjDSBL_ISLAND'];
/** How exactly the normal of a contact is an axis of a box, if a face of that box is met. */
const SAME = 1e-12;

export class Stepping {
  /**
   * @param {MuJoCo} mujoco
   * @param {any} model Its options are changed; its only equalities are welds (`mjcf.py`).
   * @param {any} data
   */
  constructor(mujoco, model, data) {
    this.mujoco = mujoco;
    this.model = model;
    this.data = data;
    for (const flag of LATER) model.opt.disableflags |= mujoco.mjtDisableBit[flag].value;
    const box = mujoco.mjtGeom.mjGEOM_BOX.value;
    /** By shape. @type {boolean[]} */
    this.boxes = Array.from(model.geom_type, type => type === box);
    this.equality = mujoco.mjtConstraint.mjCNSTR_EQUALITY.value;
    this.velocities = mujoco.mjtStage.mjSTAGE_VEL.value;
  }

  /** One step of Euler's integrator. */
  step() {
    const {mujoco, model, data} = this;
    mujoco.mj_checkPos(model, data);
    mujoco.mj_checkVel(model, data);
    this.evaluate();
    mujoco.mj_checkAcc(model, data);
    mujoco.mj_Euler(model, data);
  }

  /** Works out where everything is, and what the next step starts from. */
  forward() {
    this.evaluate();
    this.data.qacc_warmstart.set(this.data.qacc);
  }

  /** What MuJoCo's `mj_forward` does, stage by stage. */
  evaluate() {
    const {mujoco, model, data} = this;
    mujoco.mj_fwdKinematics(model, data);
    mujoco.mj_makeM(model, data);
    mujoco.mj_factorM(model, data);
    mujoco.mj_collision(model, data);
    this.halveFaces();
    mujoco.mj_makeConstraint(model, data);
    mujoco.mj_island(model, data);
    mujoco.mj_projectConstraint(model, data);
    mujoco.mj_transmission(model, data);
    mujoco.mj_fwdVelocity(model, data);
    this.stillWelds();
    mujoco.mj_forwardSkip(model, data, this.velocities, 0);
  }

  /** Gives contacts of two boxes half of their depth, where a face is met. */
  halveFaces() {
    const {mujoco, model, data} = this;
    const contacts = data.contact;
    const copies = Array.from({length: contacts.size()}, (_, i) => contacts.get(i));
    contacts.delete();
    const faces = copies.filter(contact => this.meetsFace(contact));
    for (const contact of faces) contact.dist *= 0.5;
    if (faces.length > 0) {
      // What MuJoCo hands out are copies, so they are all added again.
      data.ncon = 0;
      for (const contact of copies) mujoco.mj_addContact(model, data, contact);
    }
    for (const contact of copies) contact.delete();
  }

  /**
   * Whether a contact is one of two boxes, and along an axis of one of them.
   * @param {any} contact
   */
  meetsFace(contact) {
    const pair = [contact.geom1, contact.geom2];
    if (!pair.every(geom => this.boxes[geom])) return false;
    const normal = contact.frame.slice(0, 3);
    const turned = this.data.geom_xmat;
    return pair.some(geom => [0, 1, 2].some(axis => isAlong(normal, turned, 9 * geom + axis)));
  }

  /** Works out the reference acceleration of welds from their place and speed alone. */
  stillWelds() {
    const {efc_type, efc_aref, efc_KBIP, efc_vel, efc_pos, efc_margin} = this.data;
    for (let row = 0; row < this.data.nefc && efc_type[row] === this.equality; row++) {
      const [stiffness, damping, impedance] = efc_KBIP.subarray(4 * row, 4 * row + 3);
      efc_aref[row] =
        -damping * efc_vel[row] - stiffness * impedance * (efc_pos[row] - efc_margin[row]);
    }
  }
}

/**
 * @param {Float64Array} normal (3), of length 1.
 * @param {Float64Array} matrices (3, 3) each, row by row.
 * @param {number} first Where a column begins.
 */
function isAlong(normal, matrices, first) {
  const column = [0, 1, 2].map(row => matrices[first + 3 * row]);
  const inner = column.reduce((sum, value, i) => sum + value * normal[i], 0);
  return column.every((value, i) => Math.abs(normal[i] - Math.sign(inner) * value) < SAME);
}
