/** The sentence over the table of success: the same cases as Python's. */

import assert from 'node:assert/strict';
import {readFileSync} from 'node:fs';
import test from 'node:test';

import {wilson} from '../../madviz/site/web/statistics.js';
import {needsWords} from '../../madviz/site/web/success.js';

const CASES = JSON.parse(readFileSync(new URL('./needs.json', import.meta.url), 'utf8'));
const CAMERAS = [['first', 'First person'], ['third_a', 'Third A'], ['third_b', 'Third B']]
  .map(([name, label]) => ({name, label}));

/** @param {number[]} wins Of 100 episodes: with all, without First person, Third A, Third B. */
function entry(...wins) {
  const subsets = ['all', 'third_a+third_b', 'first+third_b', 'first+third_a'];
  const rates = wins.map((won, i) =>
    [subsets[i], {success: won / 100, ci95: wilson(won, 100), n: 100}]);
  return {label: 'P', cameras: CAMERAS, measured: Object.fromEntries(rates)};
}

test('the sentence is that of the table', () => {
  assert.ok(CASES.length > 4);
  for (const {wins, words} of CASES) assert.equal(needsWords(entry(...wins)), words);
});
