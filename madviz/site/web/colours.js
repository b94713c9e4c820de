/** Colours with a meaning: one for each camera, everywhere; and a scale from dark to bright. */

const CAMERAS = 6; // Variables --c0 to --c5 of style.css.

/**
 * @param {number} index Of the camera, in the policy's order.
 * @returns {string} The name of its colour, for CSS.
 */
export function cameraColour(index) {
  return `var(--c${index % CAMERAS})`;
}

/**
 * The same as the browser resolves it here, light or dark, for a canvas.
 * @param {number} index
 */
export function cameraColourNow(index) {
  const style = getComputedStyle(document.documentElement);
  return style.getPropertyValue(`--c${index % CAMERAS}`).trim();
}

/** @param {string} name For example `--soft`. */
export function colourNow(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

/** Blue to yellow, rising in brightness all the way, so that grey prints keep the order. */
const SCALE = [[0, 32, 77], [60, 77, 110], [124, 123, 120], [187, 175, 113], [255, 234, 70]];

/**
 * @param {number} share From 0 to 1.
 * @returns {[number, number, number]} Red, green, blue, each to 255.
 */
export function scaleColour(share) {
  const at = Math.min(Math.max(share || 0, 0), 1) * (SCALE.length - 1);
  const low = Math.min(Math.floor(at), SCALE.length - 2), rest = at - low;
  const mix = SCALE[low].map((value, i) => Math.round(value + rest * (SCALE[low + 1][i] - value)));
  return /** @type {[number, number, number]} */ (mix);
}
