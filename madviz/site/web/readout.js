/**
 * What the policy makes of the pictures: features, their sum, and what it would do otherwise.
 *
 * Two panels for each side. The table reads every subset of cameras at the same time step; it may
 * be some steps old, and says so.
 */

import {cameraColour, cameraColourNow, colourNow, scaleColour} from './colours.js';
import {make, say, term} from './dom.js';
import {nameOf} from './subsets.js';
import {subsetWords} from './words.js';

/** @typedef {import('./messages.js').World} World */
/** @typedef {import('./catalogue.js').Entry} Entry */

const MOST_ROWS = 16;

/** A curve of the norm of each camera's feature, and the sum's numbers as a strip. */
export class Features {
  /** @param {Entry} entry */
  constructor(entry) {
    this.entry = entry;
    this.chart = make('canvas', {width: 560, height: 120, role: 'img'});
    this.strip = make('canvas', {width: 112, height: 28, role: 'img',
      'aria-label': 'The merged feature, one cell for each number; bright is large'});
    this.words = make('p', {class: 'soft num'});
    const key = entry.streams.map((stream, index) => {
      const swatch = make('i', {class: 'swatch'});
      swatch.style.setProperty('--c', cameraColour(this.cameraOf(stream)));
      if (stream.endsWith('.depth')) swatch.classList.add('dashed');
      return make('span', {'data-index': index}, swatch, subsetWords(stream, entry.cameras));
    });
    this.element = make('section', {class: 'panel'},
      make('h3', {}, 'Features: how strongly each camera counts'),
      make('div', {class: 'key'}, ...key, make('span', {},
        make('i', {class: 'swatch merged'}), 'merged')), this.chart,
      make('h3', {}, term('merged feature', 'Merged feature')), this.strip, this.words);
    /** @type {number[][]} By step: norms of the streams, and of the merged feature. */
    this.past = [];
    this.episode = -1;
  }

  /** @param {string} stream */
  cameraOf(stream) {
    return this.entry.cameras.findIndex(camera => camera.name === stream.split('.')[0]);
  }

  /** @param {World} world */
  add(world) {
    if (world.episode !== this.episode) [this.episode, this.past] = [world.episode, []];
    this.past.length = Math.min(this.past.length, world.step);
    this.past[world.step] = [...world.norms, norm(world.merged)];
  }

  /** @param {World} world */
  draw(world) {
    const now = this.past[world.step] ?? [];
    say(this.words, `Norm now: ${now.map((value, i) => `${i < world.streams.length
      ? subsetWords(world.streams[i], this.entry.cameras) : 'merged'} ${value.toFixed(1)}`)
      .join(', ')}`);
    this.chart.setAttribute('aria-label', `Norms of the features by step. ${this.words.textContent}`);
    this.curves(world);
    this.cells(world.merged);
  }

  /** @param {World} world */
  curves(world) {
    const context = this.chart.getContext('2d');
    if (!context) return;
    const {width, height} = this.chart;
    const most = Math.max(1e-6, ...this.past.flatMap(row => row ?? []));
    context.clearRect(0, 0, width, height);
    context.fillStyle = colourNow('--line');
    context.fillRect(0, height - 1, width, 1);
    const count = world.norms.length;
    for (let i = 0; i <= count; i += 1) {
      const stream = world.streams[i], merged = i === count;
      context.strokeStyle = merged ? colourNow('--ink') : cameraColourNow(this.cameraOf(stream));
      context.lineWidth = merged ? 2 : 2.5;
      context.setLineDash(stream?.endsWith('.depth') ? [6, 4] : []);
      context.beginPath();
      let joined = false;
      this.past.forEach((row, step) => {
        const x = step / this.entry.horizon * width;
        const y = height - 3 - row[i] / most * (height - 8);
        if (joined) context.lineTo(x, y); else context.moveTo(x, y);
        joined = true;
      });
      context.stroke();
    }
  }

  /** @param {Float32Array} merged (Z) */
  cells(merged) {
    const context = this.strip.getContext('2d');
    if (!context || merged.length === 0) return;
    const columns = Math.min(112, merged.length), rows = Math.ceil(merged.length / columns);
    if (this.strip.height !== rows) [this.strip.width, this.strip.height] = [columns, rows];
    const image = context.createImageData(columns, rows);
    const most = merged.reduce((top, value) => Math.max(top, Math.abs(value)), 1e-6);
    merged.forEach((value, i) => {
      image.data.set([...scaleColour(Math.sqrt(Math.abs(value) / most)), 255], 4 * i);
    });
    context.putImageData(image, 0, 0);
  }
}

/** Action and Q of every subset at one time step. */
export class Subsets {
  /** @param {Entry} entry */
  constructor(entry) {
    this.entry = entry;
    this.body = make('tbody');
    /** @type {import('./messages.js').Readout | null} The newest one of this episode. */
    this.last = null;
    this.episode = -1;
    this.age = make('p', {class: 'soft'});
    this.element = make('section', {class: 'panel'},
      make('h3', {}, 'What it would do now with other cameras'),
      make('div', {class: 'scroll'}, make('table', {class: 'subsets'},
        make('thead', {}, make('tr', {}, ...['cameras', 'action', 'apart', 'Q'].map(words =>
          make('th', {scope: 'col'}, term(words))))), this.body)),
      this.age);
  }

  /** @param {World} world */
  draw(world) {
    if (world.readout || world.episode !== this.episode) this.last = world.readout;
    this.episode = world.episode;
    const readout = this.last;
    if (!readout) return say(this.age, 'No readout yet.');
    const size = world.action.length;
    const now = readout.subsets.indexOf(nameOf(world.mask, world.streams));
    const rows = readout.subsets.slice(0, MOST_ROWS).map((subset, i) => {
      const action = [...readout.action.slice(i * size, (i + 1) * size)];
      const base = now < 0 ? world.action : readout.action.slice(now * size, (now + 1) * size);
      const apart = Math.hypot(...action.map((value, k) => value - base[k]));
      return this.row(subset, action, apart, readout.q[i], i === now);
    });
    this.body.replaceChildren(...rows);
    const age = world.step - readout.step;
    say(this.age, `† not trained on. “apart”: distance from the action that is taken. ${age > 0
      ? `Read ${age} ${age === 1 ? 'step' : 'steps'} ago.` : ''}`);
  }

  /** @param {string} subset @param {number[]} action @param {number} apart @param {number} q
   * @param {boolean} current */
  row(subset, action, apart, q, current) {
    const trained = this.entry.trained_subsets.includes(subset);
    const bars = make('span', {class: 'hands', role: 'img',
      'aria-label': action.map(value => value.toFixed(2)).join(', ')},
    ...action.map(value => {
      const bar = make('i');
      bar.style.setProperty('--from', `${50 + 50 * Math.min(clamped(value), 0)}%`);
      bar.style.setProperty('--size', `${50 * Math.abs(clamped(value))}%`);
      return make('span', {}, bar);
    }));
    return make('tr', {class: current ? 'current' : '', 'aria-current': current && 'true'},
      make('th', {scope: 'row'}, ...this.squares(subset),
        subsetWords(subset, this.entry.cameras) + (trained ? '' : ' †')),
      make('td', {}, bars), make('td', {class: 'num'}, shown(apart, 2)),
      make('td', {class: 'num'}, shown(q, 1)));
  }

  /** @param {string} subset */
  squares(subset) {
    const parts = subset.split('+');
    return this.entry.cameras.map((camera, index) => {
      const on = ['all', 'rgb', 'depth'].includes(subset)
        || parts.some(part => part.split('.')[0] === camera.name);
      const square = make('i', {class: on ? 'square on' : 'square'});
      square.style.setProperty('--c', cameraColour(index));
      return square;
    });
  }
}

/** @param {number} value */
function clamped(value) {
  return Number.isFinite(value) ? Math.min(Math.max(value, -1), 1) : 0;
}

/** @param {number} value @param {number} digits */
function shown(value, digits) {
  return Number.isFinite(value) ? value.toFixed(digits) : '–';
}

/** @param {Float32Array} vector */
function norm(vector) {
  return Math.sqrt(vector.reduce((sum, value) => sum + value * value, 0));
}
