/**
 * When each of the 15 Meta-World tasks is a success: one line for each, and the only place for it.
 * Metres; `target` is where the object has to go, shipped with every start state. How an episode
 * begins needs no line: a start state is set as it is (`madviz/site/starts.py`).
 */

/** @typedef {import('./physics.js').Physics} Physics */
/** @typedef {[number, number, number] | Float64Array} Point */

/** @type {Record<string, (world: Physics, target: Float64Array) => boolean>} */
export const SUCCESS = {
  'metaworld/assembly': (world, target) => {
    const nut = world.site('RoundNut');
    return distance(flat(nut), flat(target)) < 0.02 && target[2] > nut[2];
  },
  'metaworld/basketball': (world, target) =>
    distance(world.body('bsktball'), [target[0], target[1], 0.3], [1, 1, 2]) <= 0.08,
  'metaworld/disassemble': (world, target) => world.site('RoundNut-8')[2] > target[2],
  'metaworld/hammer': world => world.joint('NailSlideJoint') > 0.09,
  'metaworld/hand-insert': (world, target) => distance(world.body('obj'), target) <= 0.05,
  'metaworld/peg-insert-side': (world, target) =>
    distance(world.site('pegHead'), target, [1, 2, 2]) <= 0.07,
  'metaworld/pick-out-of-hole': (world, target) => distance(world.body('obj'), target) <= 0.07,
  'metaworld/pick-place': (world, target) => distance(world.body('obj'), target) <= 0.07,
  'metaworld/pick-place-wall': (world, target) => distance(world.geom('objGeom'), target) <= 0.07,
  'metaworld/push': (world, target) => distance(world.body('obj'), target) <= 0.05,
  'metaworld/shelf-place': (world, target) => distance(world.body('obj'), target) <= 0.07,
  'metaworld/soccer': (world, target) =>
    distance(world.body('soccer_ball'), target, [3, 1, 1]) <= 0.07,
  'metaworld/stick-pull': (world, target) => {
    const handle = world.site('insertion');
    const end = world.site('stick_end');
    const inserted =
      end[0] >= handle[0] &&
      Math.abs(end[1] - handle[1]) <= 0.04 &&
      Math.abs(end[2] - handle[2]) <= 0.06;
    return distance(handle, target) <= 0.12 && inserted;
  },
  'metaworld/stick-push': (world, target) => {
    const [x, y, z] = world.site('insertion');
    const held = world.pinched() && world.gripper > 0;
    const lifted = world.body('stick')[2] - 0.01 > world.lifted;
    return distance([x, y + 0.09, z], target) <= 0.12 && held && lifted;
  },
  'metaworld/sweep-into': (world, target) =>
    distance(flat(world.body('obj')), flat(target)) <= 0.05,
};

/**
 * @param {Point} a
 * @param {Point} b
 * @param {number[]} scale Of the axes.
 */
function distance(a, b, scale = [1, 1, 1]) {
  return Math.hypot(...scale.map((factor, axis) => factor * (a[axis] - b[axis])));
}

/**
 * Seen from above.
 * @param {Point} point
 * @returns {Point}
 */
function flat(point) {
  return [point[0], point[1], 0];
}
