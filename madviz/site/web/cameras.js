/**
 * Where cameras are: those that stand, the one that goes with the hand, and those that were moved.
 *
 * A displacement counts along the camera's own axes as it stood in training, as in
 * `madviz/observation/displacement.py`: first it goes (right, up, forward), then it turns, then it
 * zooms. Axes are OpenGL's here: x right, y up, looking along -z.
 */

/** @typedef {import('./messages.js').CameraSpec} CameraSpec */
/** @typedef {import('./messages.js').CameraPose} CameraPose */
/** @typedef {import('./messages.js').Displacement} Displacement */
/** @typedef {import('./pictures.js').Eye} Eye */
/** @typedef {[number, number, number, number]} Quaternion w, x, y, z. */
/** @typedef {{body: (name: string) => ArrayLike<number>}} Bodies */

/** Between OpenGL's axes and OpenCV's: half a turn about x. @type {Quaternion} */
const HALF_TURN = [0, 1, 0, 0];
/** Degrees of a field of view that are drawn. */
const [NARROWEST, WIDEST] = [5, 150];

/**
 * @param {CameraSpec[]} cameras
 * @param {Record<string, Displacement>} moves
 * @param {Bodies} bodies
 * @returns {Eye[]}
 */
export function eyes(cameras, moves, bodies) {
  return cameras.map(camera => {
    const {position, wxyz, fovy} = placed(camera, moves[camera.name], bodies);
    return {position, rotation: matrix(wxyz), fovy, depth_range: camera.depth_range};
  });
}

/**
 * @param {CameraSpec} camera
 * @param {Displacement | undefined} move
 * @param {Bodies} bodies
 * @returns {CameraPose} In OpenCV's axes.
 */
export function cameraPose(camera, move, bodies) {
  const {position, wxyz, fovy} = placed(camera, move, bodies);
  return {position, wxyz: product(wxyz, HALF_TURN), fovy};
}

/**
 * @param {CameraSpec} camera
 * @param {Displacement | undefined} move
 * @param {Bodies} bodies
 * @returns {{position: [number, number, number], wxyz: Quaternion, fovy: number}}
 */
function placed(camera, move, bodies) {
  const origin = camera.body === null ? [0, 0, 0] : bodies.body(camera.body);
  const before = unit(camera.wxyz);
  const axes = matrix(before);
  const way = move ? [move.right, move.up, -move.forward] : [0, 0, 0];
  const at = (/** @type {number} */ row) => origin[row] + camera.position[row]
    + axes[3 * row] * way[0] + axes[3 * row + 1] * way[1] + axes[3 * row + 2] * way[2];
  if (!move) return {position: [at(0), at(1), at(2)], wxyz: before, fovy: camera.fovy};
  const turned = product(product(before, about('y', -move.pan)), about('x', move.tilt));
  const half = Math.tan(camera.fovy * Math.PI / 360) / move.zoom;
  const fovy = Math.min(Math.max(Math.atan(half) * 360 / Math.PI, NARROWEST), WIDEST);
  return {position: [at(0), at(1), at(2)], wxyz: turned, fovy};
}

/**
 * @param {'x' | 'y'} axis
 * @param {number} degrees
 * @returns {Quaternion}
 */
function about(axis, degrees) {
  const half = degrees * Math.PI / 360;
  const [c, s] = [Math.cos(half), Math.sin(half)];
  return axis === 'x' ? [c, s, 0, 0] : [c, 0, s, 0];
}

/**
 * @param {Quaternion} a
 * @param {Quaternion} b
 * @returns {Quaternion} First b, then a.
 */
function product([w, x, y, z], [a, b, c, d]) {
  return [
    w * a - x * b - y * c - z * d,
    w * b + x * a + y * d - z * c,
    w * c - x * d + y * a + z * b,
    w * d + x * c - y * b + z * a,
  ];
}

/**
 * @param {Quaternion} quaternion
 * @returns {Quaternion}
 */
function unit(quaternion) {
  const length = Math.hypot(...quaternion);
  const [w, x, y, z] = quaternion;
  return [w / length, x / length, y / length, z / length];
}

/**
 * @param {Quaternion} quaternion
 * @returns {number[]} Nine numbers, row by row.
 */
function matrix([w, x, y, z]) {
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
  ];
}
