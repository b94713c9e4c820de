/** Q by step, with a mark where a camera was switched: what both sides expected, and when. */

import {cameraColourNow, colourNow} from './colours.js';
import {make, say} from './dom.js';
import {eventWords} from './words.js';

/** @typedef {import('./messages.js').Frame} Frame */
/** @typedef {import('./messages.js').World} World */
/** @typedef {import('./catalogue.js').Entry} Entry */

export class Timeline {
  /** @param {HTMLElement} element */
  constructor(element) {
    this.canvas = make('canvas', {width: 1200, height: 64, role: 'img'});
    this.key = make('span');
    this.now = make('span', {class: 'now num'});
    element.replaceChildren(make('p', {}, this.key, this.now), this.canvas);
    /** @type {Record<'first' | 'second', number[]>} */
    this.q = {first: [], second: []};
    this.episode = '';
  }

  /** @param {Frame} frame */
  add(frame) {
    const {first, second} = frame; // Live and recorded episodes are each counted from 1.
    const episode = [first.episode, first.policy, second?.policy].join();
    if (episode !== this.episode) [this.episode, this.q] = [episode, {first: [], second: []}];
    this.q.first[frame.first.step] = frame.first.q;
    if (frame.second) this.q.second[frame.second.step] = frame.second.q;
  }

  /** @param {Frame} frame @param {Entry} entry @param {string} rate In words. */
  draw(frame, entry, rate) {
    const {step, seed} = frame.first;
    say(this.key, frame.second
      ? 'Q, the reward that each policy still expects: solid A, dashed B'
      : 'Q, the reward that the policy still expects');
    say(this.now, `seed ${seed} · step ${step} of ${entry.horizon}${rate ? ` · ${rate}` : ''}`);
    this.canvas.setAttribute('aria-label', `Q by step, now ${frame.first.q.toFixed(1)}${
      frame.second ? ` and ${frame.second.q.toFixed(1)}` : ''}.`);
    const context = this.canvas.getContext('2d');
    const wide = Math.round(this.canvas.getBoundingClientRect().width) || 1200;
    if (this.canvas.width !== wide) this.canvas.width = wide;
    if (!context) return;
    context.clearRect(0, 0, wide, 64);
    this.marks(context, frame, entry, wide);
    this.curve(context, this.q.first, entry.horizon, wide, []);
    this.curve(context, this.q.second, entry.horizon, wide, [5, 4]);
    context.fillStyle = colourNow('--ink');
    context.fillRect(Math.min(step / entry.horizon * wide, wide - 2), 0, 2, 64);
  }

  /** @param {CanvasRenderingContext2D} context @param {number[]} q @param {number} horizon
   * @param {number} wide @param {number[]} dashes */
  curve(context, q, horizon, wide, dashes) {
    const known = [...this.q.first, ...this.q.second].filter(Number.isFinite);
    const least = Math.min(0, ...known), most = Math.max(least + 1, ...known);
    context.strokeStyle = colourNow(dashes.length ? '--soft' : '--accent');
    context.lineWidth = 2;
    context.setLineDash(dashes);
    context.beginPath();
    let joined = false;
    q.forEach((value, step) => {
      if (!Number.isFinite(value)) return;
      const y = 60 - (value - least) / (most - least) * 54;
      if (joined) context.lineTo(step / horizon * wide, y);
      else context.moveTo(step / horizon * wide, y);
      joined = true;
    });
    context.stroke();
    context.setLineDash([]);
  }

  /** @param {CanvasRenderingContext2D} context @param {Frame} frame @param {Entry} entry
   * @param {number} wide */
  marks(context, frame, entry, wide) {
    context.font = '12px system-ui, sans-serif';
    const events = frame.first.events.filter(one => one.step > 0);
    for (const [number, event] of events.entries()) {
      const index = entry.cameras.findIndex(camera => camera.name === event.camera);
      const x = event.step / entry.horizon * wide;
      context.fillStyle = index < 0 ? colourNow('--ink') : cameraColourNow(index);
      context.fillRect(x - 1.5, 0, 3, 64);
      const words = eventWords(event, entry.cameras);
      const room = context.measureText(words).width;
      context.fillStyle = colourNow('--ink');
      // Words of neighbours stand below each other.
      context.fillText(words, x + room + 8 < wide ? x + 5 : x - room - 6, 12 + number % 4 * 15);
    }
  }
}
