/**
 * A picture as a few whole numbers, the same as `madviz/guard/pictures.py` has.
 *
 * The picture is cut into 21 x 21 cells of about equal size. A cell holds the sum of all its pixels
 * and colours. Every fourth row of the middle colour channel gives the differences of neighbours.
 */

/** @typedef {import('./messages.js').Picture} Picture */
/**
 * @typedef {object} Sums
 * @property {Float64Array} cells (441) Whole numbers.
 * @property {number} spread The standard deviation of `cells`: 0 for an even picture.
 * @property {number} dark How many cells are dark.
 * @property {number} rough The sum of the differences of neighbours: large for noise.
 * @property {number} edges How many neighbours are edges: few in a blurred picture.
 */

export const CELLS = 21;
const ROWS = 4;
/** A cell is dark where its pixels are at most this on average, of 255. */
const DARK = 8;
/** Two neighbours that differ by this or more are an edge. */
const EDGE = 16;
/** By count of rows or columns. @type {Map<number, Uint8Array>} */
const kept = new Map();

/** @param {Picture} picture @returns {Sums} */
export function sumsOf({width, height, rgba}) {
  const rows = cellsOf(height), columns = cellsOf(width);
  const cells = new Float64Array(CELLS * CELLS), sizes = new Float64Array(CELLS * CELLS);
  let rough = 0, edges = 0;
  for (let y = 0, at = 0; y < height; y++) {
    for (let x = 0; x < width; x++, at += 4) {
      const cell = CELLS * rows[y] + columns[x];
      cells[cell] += rgba[at] + rgba[at + 1] + rgba[at + 2];
      sizes[cell] += 1;
      if (y % ROWS || x === 0) continue;
      const step = Math.abs(rgba[at + 1] - rgba[at - 3]);
      rough += step;
      edges += step >= EDGE ? 1 : 0;
    }
  }
  let total = 0, square = 0, dark = 0;
  cells.forEach((cell, i) => {
    total += cell;
    square += cell * cell;
    dark += cell <= 3 * DARK * sizes[i] ? 1 : 0;
  });
  const count = cells.length; // All numbers are whole, and exact for pictures of some 300 pixels.
  const spread = Math.sqrt(Math.max(count * square - total * total, 0)) / count;
  return {cells, spread, dark, rough, edges};
}

/** The cell of each row, or column. @param {number} count */
function cellsOf(count) {
  let cells = kept.get(count);
  if (!cells) {
    cells = new Uint8Array(count);
    for (let cell = 0; cell < CELLS; cell++) cells.fill(cell, Math.floor(cell * count / CELLS));
    kept.set(count, cells);
  }
  return cells;
}
