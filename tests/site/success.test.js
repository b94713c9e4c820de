/** The sentence over the table of success. */

import assert from 'node:assert/strict';
import test from 'node:test';

import {wilson} from '../../madviz/site/web/statistics.js';
import {needsWords} from '../../madviz/site/web/success.js';

const CAMERAS = [['first', 'First person'], ['third_a', 'Third A'], ['third_b', 'Third B']]
  .map(([name, label]) => ({name, label}));

/** @param {number[]} wins Of 100 episodes: with all, without First person, Third A, Third B. */
function entry(...wins) {
  const subsets = ['all', 'third_a+third_b', 'first+third_b', 'first+third_a'];
  const rates = wins.map((won, i) =>
    [subsets[i], {success: won / 100, ci95: wilson(won, 100), n: 100}]);
  return {label: 'P', cameras: CAMERAS, measured: Object.fromEntries(rates)};
}

test('a policy needs a camera without which at most half of its success is left', () => {
  assert.equal(needsWords(entry(100, 0, 77, 100)),
    'P needs First person: without it, 0.00 [0.00, 0.04] n=100.');
  assert.match(needsWords(entry(100, 0, 10, 100)), /^P needs First person and Third A: without it, 0.00/);
  assert.equal(needsWords(entry(99, 100, 98, 99)),
    'P needs no single camera: without any one, at least 0.98 [0.93, 0.99] n=100.');
});

test('what is not decided, or was not measured, is not said', () => {
  assert.equal(needsWords(entry(100, 45, 100, 100)), '');
  assert.equal(needsWords(entry(100, 55, 100, 100)), '');
  assert.equal(needsWords(entry(100, 0)), '');
});
