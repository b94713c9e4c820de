/** Switches that act on two policies of which one gets more than the other. */

import assert from 'node:assert/strict';
import test from 'node:test';

import {intact} from '../../madviz/site/web/camera_state.js';
import {Explorer} from '../../madviz/site/web/explorer.js';
import {choicesOf} from '../../madviz/site/web/switches.js';

const CAMERAS = [{name: 'first'}];
const plain = {streams: ['first'], cameras: CAMERAS};
const deep = {streams: ['first.rgb', 'first.depth'], cameras: CAMERAS};

test('a switch offers what every policy gets on which it acts', () => {
  const offered = (...entries) => choicesOf(entries, 'first').map(([value]) => value);
  assert.deepEqual(offered(deep), ['rgb', 'depth', 'both', 'off']);
  assert.deepEqual(offered(deep, deep), ['rgb', 'depth', 'both', 'off']);
  assert.deepEqual(offered(deep, plain), ['rgb', 'both', 'off']);
  assert.deepEqual(offered(plain, deep), ['rgb', 'both', 'off']);
  assert.deepEqual(offered(plain, plain), ['both', 'off']);
});

/** What is sent where A gets depth alone and the sides are made alike. */
function madeAlike(...entries) {
  const depth = {...intact(), input: 'depth'}, sent = [];
  const planned = [{step: 9, side: 'first', camera: 'first', state: depth}];
  const page = {entries, planned, setLinked() {}, send: command => sent.push(command),
    frame: {first: {cameras: {first: depth}, moves: {}}, second: {cameras: {first: intact()}, moves: {}}}};
  Explorer.prototype.choose.call(page, true);
  return [sent.filter(one => one.kind === 'SetCamera').map(({side, state}) => [side, state.input]),
    page.planned.map(({side, state}) => [side, state.input])];
}

test('sides are made alike with what both policies get', () => {
  assert.deepEqual(madeAlike(deep, deep), [[['second', 'depth']], [['both', 'depth']]]);
  assert.deepEqual(madeAlike(deep, plain), [[['first', 'both']], []]);
});
