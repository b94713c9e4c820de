/** Lesson 0: right answers, empty ones, and typical mistakes. */

import assert from 'node:assert/strict';
import test from 'node:test';

import {HINTS, linkLacks, MAD, MERGED_ONLY, ratesLack} from '../../madviz/site/web/lesson_checks.js';

const rate = success => ({success, n: 100, ci95: [0, 1]});
const MEASURED = {
  [MAD]: {'third_a+third_b': rate(1), first: rate(0.9)},
  [MERGED_ONLY]: {'third_a+third_b': rate(0), first: rate(0.02)},
};

test('rates', () => {
  assert.equal(ratesLack('1.00', '0', MEASURED), '');
  assert.equal(ratesLack('1,00', '0,00', MEASURED), '', 'a comma is a point in many countries');
  assert.match(ratesLack('', '0', MEASURED), /Nothing is answered/);
  assert.match(ratesLack('0', '1', MEASURED), /changed places/);
  assert.match(ratesLack('0.9', '0.02', MEASURED), /First person alone/);
  assert.match(ratesLack('100', '0', MEASURED), /from 0 to 1/);
  assert.match(ratesLack('0.5', '0.5', MEASURED), /not the rates/);
});

test('link', () => {
  const own = `#policy=${MERGED_ONLY}`;
  assert.equal(linkLacks(`${own}&third_a=black@20`), '');
  assert.equal(linkLacks(`https://example.org/site/${own}&seed=5003&third_a=black@20`), '');
  assert.match(linkLacks(' '), /Nothing is answered/);
  assert.match(linkLacks('third_a=black@20'), /not Merged Only/);
  assert.match(linkLacks(`${own}&third_a=off@20`), /Off leaves the sum/);
  assert.match(linkLacks(`${own}&first=black@20`), /another camera/);
  assert.match(linkLacks(`${own}&third_a=black`), /at step 0/);
  assert.match(linkLacks(own), /No camera/);
  assert.match(linkLacks(`${own}&third_a=off@10&third_a=black@20`), /More than one thing/);
  assert.match(linkLacks(`${own}&vs=${MAD}&b.third_a=black@20`), /side B/);
  assert.equal(linkLacks(`${own}&vs=${MAD}&third_a=both:black@20`), '');
  assert.match(linkLacks(`${own}&third a=black`), /cannot be read/);
  assert.match(linkLacks(`${own}&third_a=depth:black@20`), /no depth/);
});

test('three hints each', () => {
  for (const hints of Object.values(HINTS)) assert.equal(hints.length, 3);
});
