/**
 * One robot: who acts, how the episode stands, the scene, and the pictures that reach the policy.
 *
 * The page has one or two of these, beside each other. A `Side` draws what a frame holds and keeps
 * no state of the simulation.
 */

import {cameraColour} from './colours.js';
import {make, say} from './dom.js';
import {listed} from './ending.js';
import {dragBoxes} from './patch_box.js';
import {badgeWords, labelOf, outcomeWords, subsetWords, tagWords} from './words.js';

/** @typedef {import('./messages.js').World} World */
/** @typedef {import('./catalogue.js').Entry} Entry */
/**
 * @typedef {object} View A camera's picture.
 * @property {HTMLElement} figure
 * @property {HTMLCanvasElement[]} canvases By modality.
 * @property {HTMLElement} tag
 */

export class Side {
  /**
   * @param {'first' | 'second'} name
   * @param {(camera: string, box: import('./patch_box.js').Box) => void} onBox A box was dragged.
   */
  constructor(name, onBox) {
    this.name = name;
    this.onBox = onBox;
    this.letter = name === 'first' ? 'A' : 'B';
    this.title = make('h2', {id: `title-${name}`});
    this.outcome = make('span', {class: 'outcome'});
    this.about = make('p', {class: 'about'});
    this.canvas = make('canvas', {tabindex: '0', role: 'img'});
    this.hint = make('span', {class: 'hint'});
    this.scene = make('div', {class: 'scene'}, this.canvas, this.hint);
    this.views = make('div', {class: 'views'});
    this.element = make('article', {class: 'side', 'aria-labelledby': `title-${name}`},
      make('header', {}, make('span', {class: 'letter'}, this.letter), this.title, this.outcome),
      this.about, this.scene, this.views);
    /** @type {Map<string, View>} */
    this.cameras = new Map();
    /** @type {Entry | null} */
    this.entry = null;
  }

  /** @param {Entry} entry Who acts here from now on. */
  show(entry) {
    if (this.entry?.name === entry.name) return;
    this.entry = entry;
    say(this.title, entry.label);
    const trained = entry.trained_subsets.map(one => subsetWords(one, entry.cameras));
    const film = entry.task.startsWith('maniskill/')
      ? 'A recording (models of ManiSkill: CC BY-NC 4.0). ' : 'A recording. ';
    const shown = trained.length > 5 ? [...trained.slice(0, 3), `${trained.length - 3} more`] : trained;
    say(this.about, `${entry.recorded ? film : ''}Trained on ${listed(shown)}.`);
    this.canvas.setAttribute('aria-label',
      `Scene of side ${this.letter}. Arrow keys turn it, plus and minus zoom.`);
    this.views.style.setProperty('--count', String(Math.min(entry.cameras.length, 5)));
    this.views.toggleAttribute('data-split', entry.streams.length > entry.cameras.length);
    this.cameras.clear();
    this.views.replaceChildren(...entry.cameras.map((camera, index) => {
      const view = this.view(camera.name, index, entry);
      this.cameras.set(camera.name, view);
      return view.figure;
    }));
  }

  /**
   * @param {string} camera
   * @param {number} index
   * @param {Entry} entry
   * @returns {View}
   */
  view(camera, index, entry) {
    const streams = entry.streams.filter(stream => stream.split('.')[0] === camera);
    const label = labelOf(camera, entry.cameras);
    const canvases = streams.map(stream => make('canvas', {width: 84, height: 84, role: 'img',
      'aria-label': `What ${label} sends${stream.endsWith('.depth') ? ', depth' : ''}`}));
    const tag = make('span', {class: 'tagged'});
    const picture = make('div', {class: 'picture'}, ...canvases, tag);
    picture.classList.toggle('split', canvases.length > 1);
    const figure = make('figure', {class: 'view', 'data-camera': camera}, picture,
      make('figcaption', {}, label));
    figure.style.setProperty('--c', cameraColour(index));
    if (!entry.recorded) {
      picture.title = 'Drag a box to cover a part of the picture';
      dragBoxes(picture, box => this.onBox(camera, box));
    }
    return {figure, canvases, tag};
  }

  /** @param {World} world */
  update(world) {
    const outcome = outcomeWords(world);
    say(this.outcome, outcome.text);
    this.outcome.className = `outcome ${outcome.kind}`;
    for (const [camera, view] of this.cameras) {
      const streams = Object.keys(world.arrived).filter(one => one.split('.')[0] === camera);
      streams.forEach((stream, i) => {
        draw(view.canvases[i], world.arrived[stream]);
        view.canvases[i]?.classList.toggle('out', !world.mask[world.streams.indexOf(stream)]);
      });
      const state = world.cameras[camera];
      const noticed = world.guard?.find(one => one.camera === camera);
      view.tag.classList.toggle('noticed', Boolean(noticed));
      say(view.tag, noticed ? badgeWords(noticed) : tagWords(state, world.moves[camera]));
      view.figure.classList.toggle('off', state?.input === 'off');
    }
  }
}

/**
 * @param {HTMLCanvasElement | undefined} canvas
 * @param {import('./messages.js').Picture | undefined} picture
 */
function draw(canvas, picture) {
  if (!canvas || !picture) return;
  if (canvas.width !== picture.width || canvas.height !== picture.height) {
    [canvas.width, canvas.height] = [picture.width, picture.height];
  }
  const pixels = /** @type {Uint8ClampedArray<ArrayBuffer>} */ (picture.rgba);
  canvas.getContext('2d')?.putImageData(new ImageData(pixels, picture.width, picture.height), 0, 0);
}
