/** The guard on the table of cases that Python's passes, too (`tests/guard_scene.py`). */

import assert from 'node:assert/strict';
import {readFileSync} from 'node:fs';
import test from 'node:test';

import {Guard} from '../../madviz/site/web/guard.js';
import {sumsOf} from '../../madviz/site/web/guard_pictures.js';

const TABLE = JSON.parse(readFileSync('tests/guard_cases.json', 'utf8'));
const SIZE = 42;

function draws(seed, count) {
  return Array.from({length: count}, () => {
    seed = Math.imul(seed, 1103515245) + 12345 & 0x7fffffff;
    return seed >> 15;
  });
}

/** Where the hand is, in pixels: it turns now and then, and at the borders. */
function walk(seed, steps) {
  const ways = [[1, 0], [0, 1], [-1, 0], [0, -1], [1, 1], [-1, -1]];
  let x = 21, y = 21, across = 1, down = 0;
  return draws(seed, steps).map(number => {
    const place = [x, y];
    if (number % 4 === 0) [across, down] = ways[Math.floor(number / 4) % 6];
    if (x + across < 13 || x + across > 29) across = -across;
    if (y + down < 13 || y + down > 29) down = -down;
    [x, y] = [x + across, y + down];
    return place;
  });
}

/** Squares, and a bright hill over the hand; `paint` changes a number of a colour. */
function picture([left, top], paint = value => value) {
  const rgba = new Uint8ClampedArray(4 * SIZE * SIZE);
  for (let y = 0; y < SIZE; y += 1) {
    for (let x = 0; x < SIZE; x += 1) {
      const squares = 30 + 40 * ((Math.floor(x / 3) + Math.floor(y / 3)) % 2);
      const grey = squares + Math.max(0, 130 - 8 * (Math.abs(x - left) + Math.abs(y - top)));
      const at = SIZE * y + x;
      [grey, grey, Math.floor(grey / 2)].forEach((value, c) => {
        rgba[4 * at + c] = paint(value, x, y, 3 * at + c);
      });
    }
  }
  return {width: SIZE, height: SIZE, rgba};
}

function shown(show, places, step) {
  if (typeof show === 'number') return picture(places[show]);
  const noise = show === 'noise' ? draws(step + 1, 3 * SIZE * SIZE) : [];
  const inside = (x, y) => x >= 8 && x < 30 && y >= 8 && y < 30;
  const paint = {black: () => 0, noise: (_, x, y, i) => noise[i] & 255,
    covered: (value, x, y) => inside(x, y) ? 0 : value, blurred: (_, x) => 40 + 4 * x}[show];
  return paint ? picture(places[step], paint) : null;
}

for (const {name, walk: seed, shows, kinds} of TABLE.cases) {
  test(`the verdict on every step: ${name}`, () => {
    const places = walk(seed, shows.length), guard = new Guard(TABLE.values);
    const found = shows.map((show, step) => guard.step({camera: shown(show, places, step)},
      places[step].map(number => number / 10)).camera.kind);
    assert.deepEqual(found, kinds);
  });
}

test('sums of pictures are equal, and floats within 1e-9', () => {
  const pictures = [picture([21, 21]), shown('noise', walk(1, 60), 3),
    shown('covered', walk(1, 60), 7)];
  TABLE.sums.forEach((expected, i) => {
    const {cells, spread, dark, rough, edges} = sumsOf(pictures[i]);
    assert.deepEqual([...cells.slice(0, 24)], expected.cells);
    assert.equal(cells.reduce((all, cell) => all + cell), expected.sum);
    assert.deepEqual([dark, rough, edges], [expected.dark, expected.rough, expected.edges]);
    assert.ok(Math.abs(spread - expected.spread) < 1e-9);
  });
});

test('how well each lag agrees is the same within 1e-9', () => {
  const {walk: seed, agreements} = TABLE.lags, places = walk(seed, TABLE.lags.steps);
  const guard = new Guard(TABLE.values);
  for (const place of places) {
    guard.step({camera: picture(place)}, place.map(number => number / 10));
  }
  const found = guard.watched.get('camera').lag.agreements();
  agreements.forEach((expected, lag) => assert.ok(Math.abs(found[lag] - expected) < 1e-9));
});

test('a copy goes on by itself', () => {
  const places = walk(100, 12), guard = new Guard(TABLE.values);
  places.slice(0, 8).forEach(place => guard.step({camera: picture(place)}, place));
  const copy = guard.copy(), covered = shown('covered', places, 8);
  copy.step({camera: covered}, places[8]);
  copy.step({camera: covered}, places[9]);
  guard.copy().step({camera: picture(places[8])}, places[8]);
  assert.equal(guard.watched.get('camera').memory.past.length, 8);
  assert.equal(guard.now, 8);
  assert.equal(guard.step({camera: covered}, places[8]).camera.kind, 'fine');
  assert.equal(guard.step({}, places[9]).camera, undefined);
});

test('a cell is dark up to 8 of 255', () => {
  const dark = [8, 9].map(value => sumsOf(picture([21, 21], () => value)).dark);
  assert.deepEqual(dark, [441, 0]);
});
