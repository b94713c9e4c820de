/** The states of cameras, one that nobody has touched, and the side that a switch is about. */

export const INPUTS = ['rgb', 'depth', 'both', 'off'];
export const KINDS = ['none', 'black', 'noise', 'freeze', 'blur', 'patch'];

/** @returns {import('./messages.js').CameraState} */
export function intact() {
  return {input: 'both', occlusion: noOcclusion()};
}

/** @returns {import('./messages.js').Occlusion} */
export function noOcclusion() {
  return {kind: 'none', strength: 1, x: 0.5, y: 0.5, width: 0.4, height: 0.4};
}

/** Whether what is done to `side` is done to the side with this number, from 0.
 * @param {import('./messages.js').Side} side @param {number} index */
export function covers(side, index) {
  return side === 'both' || side === (index === 0 ? 'first' : 'second');
}
