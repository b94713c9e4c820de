/** Intervals and counts of the page, against the values that madviz itself gives. */

import assert from 'node:assert/strict';
import test from 'node:test';

import {Tally, rateWords, wilson} from '../../madviz/site/web/statistics.js';

test('intervals are those that an evaluation file has', () => {
  const known = [[99, 100, 0.9455138038212947, 0.9982325679358592],
    [100, 100, 0.9630065017930143, 1], [0, 100, 0, 0.036993498206985664]];
  for (const [successes, n, low, high] of known) {
    const found = wilson(successes, n);
    assert.ok(Math.abs(found[0] - low) < 1e-12 && Math.abs(found[1] - high) < 1e-12);
  }
  assert.deepEqual(wilson(0, 0), [0, 1]);
});

test('a rate is written as everywhere', () => {
  assert.equal(rateWords(0.9, wilson(18, 20), 20), '0.90 [0.70, 0.97] n=20');
});

const outcome = (seed, success, change = {}) => ({side: 'first', policy: 'a', seed, success,
  success_any: success, condition: {subset: 'all', occlusions: ''}, ...change});

test('a seed that is played again counts once, with how it ended last', () => {
  const tally = new Tally(), condition = {subset: 'all', occlusions: ''};
  assert.equal(tally.add(outcome(5000, true)), true);
  assert.equal(tally.add(outcome(5000, true)), false);
  tally.add(outcome(5001, false));
  assert.deepEqual(tally.count('a', condition), {successes: 1, n: 2});
});

test('an episode in which somebody touched a switch does not count', () => {
  const tally = new Tally();
  tally.add(outcome(5000, true, {condition: null}));
  assert.deepEqual(tally.conditions('a'), []);
});

test('policies and conditions are counted apart', () => {
  const tally = new Tally(), black = {subset: 'all', occlusions: 'first:black,strength=1'};
  tally.add(outcome(5000, true));
  tally.add(outcome(5000, false, {condition: black}));
  tally.add(outcome(5000, false, {policy: 'a-b'}));
  assert.deepEqual(tally.count('a', black), {successes: 0, n: 1});
  assert.equal(tally.conditions('a').length, 2);
});
