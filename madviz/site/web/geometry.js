/**
 * Where things are on the orbit view: a camera that turns about a point, and frusta as lines.
 *
 * The scene is drawn by `pictures.js`; lines and names are drawn over it in two dimensions, so a
 * point needs its place on the canvas. With a vertical field of view of 45 degrees, a point 1 m
 * ahead and 0.2 m to the right is at 0.5 + 0.2 / (2 · tan 22.5° · aspect) of the width: 0.74 where
 * the picture is square.
 */

/** @typedef {[number, number, number]} Point */
/**
 * A point of view. Rows of `rotation` are the world's axes; columns: right, up, back.
 * @typedef {{position: Point, rotation: number[], fovy: number}} Viewpoint
 */
/**
 * @typedef {{target: Point, distance: number, azimuth: number, elevation: number, fovy: number}}
 *   Orbit Degrees; azimuth 0 looks along +x.
 */

const NEAR = 0.02; // Metres; nothing nearer is drawn.

/** @param {Orbit} orbit @returns {Viewpoint} */
export function viewpoint({target, distance, azimuth, elevation, fovy}) {
  const [a, e] = [azimuth, elevation].map(degrees => degrees * Math.PI / 180);
  /** @type {Point} */
  const back = [-Math.cos(a) * Math.cos(e), -Math.sin(a) * Math.cos(e), Math.sin(e)];
  /** @type {Point} */
  const right = [Math.sin(a), -Math.cos(a), 0], up = cross(back, right);
  const position = /** @type {Point} */ (target.map((value, i) => value + distance * back[i]));
  const rotation = [0, 1, 2].flatMap(row => [right[row], up[row], back[row]]);
  return {position, rotation, fovy};
}

/**
 * @param {Point} one
 * @param {Point} other
 * @returns {Point}
 */
export function cross([a, b, c], [x, y, z]) {
  return [b * z - c * y, c * x - a * z, a * y - b * x];
}

/**
 * @param {Point} point
 * @param {Viewpoint} view
 * @returns {Point} In the viewer's axes: right, up, ahead.
 */
function seen(point, {position, rotation}) {
  const offset = point.map((value, i) => value - position[i]);
  const along = [0, 1, 2].map(column =>
    offset.reduce((sum, value, row) => sum + value * rotation[3 * row + column], 0));
  return [along[0], along[1], -along[2]];
}

/**
 * A line on the canvas, cut where it comes nearer than NEAR.
 * @param {Point} from
 * @param {Point} to
 * @param {Viewpoint} view
 * @param {number} width
 * @param {number} height
 * @returns {[number, number, number, number] | null} x, y, x, y in pixels.
 */
export function lineOnCanvas(from, to, view, width, height) {
  let a = seen(from, view), b = seen(to, view);
  if (a[2] < NEAR && b[2] < NEAR) return null;
  if (a[2] < NEAR) a = cut(a, b);
  if (b[2] < NEAR) b = cut(b, a);
  return [...onCanvas(a, view.fovy, width, height), ...onCanvas(b, view.fovy, width, height)];
}

/** @param {Point} near @param {Point} far @returns {Point} */
function cut(near, far) {
  const share = (NEAR - near[2]) / (far[2] - near[2]);
  return /** @type {Point} */ (near.map((value, i) => value + share * (far[i] - value)));
}

/**
 * @param {Point} point In the viewer's axes.
 * @param {number} fovy
 * @param {number} width
 * @param {number} height
 * @returns {[number, number]}
 */
function onCanvas([right, up, ahead], fovy, width, height) {
  const scale = height / 2 / Math.tan(fovy * Math.PI / 360) / ahead;
  return [width / 2 + right * scale, height / 2 - up * scale];
}

/**
 * @param {import('./messages.js').CameraPose} pose
 * @param {number} length Metres from the tip to the picture.
 * @returns {{tip: Point, corners: Point[], top: Point}} Corners go round; `top` marks what is up.
 */
export function frustum({position, wxyz, fovy}, length) {
  const half = length * Math.tan(fovy * Math.PI / 360);
  /** @param {number} x @param {number} y @param {number} z */
  const at = (x, y, z) => {
    const turned = rotate(wxyz, [x, y, z]);
    return /** @type {Point} */ (position.map((value, i) => value + turned[i]));
  };
  return {
    tip: position,
    corners: [at(-half, -half, length), at(half, -half, length),
      at(half, half, length), at(-half, half, length)],
    top: at(0, -1.4 * half, length),
  };
}

/**
 * @param {[number, number, number, number]} wxyz
 * @param {Point} point
 * @returns {Point}
 */
export function rotate([w, x, y, z], point) {
  const once = cross([x, y, z], point);
  const twice = cross([x, y, z], once);
  return /** @type {Point} */ (point.map((value, i) => value + 2 * (w * once[i] + twice[i])));
}
