/** A camera that nobody has touched. */

/** @returns {import('./messages.js').CameraState} */
export function intact() {
  return {input: 'both', occlusion: noOcclusion()};
}

/** @returns {import('./messages.js').Occlusion} */
export function noOcclusion() {
  return {kind: 'none', strength: 1, x: 0.5, y: 0.5, width: 0.4, height: 0.4};
}
