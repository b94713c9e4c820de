/**
 * The switches of every camera: on or off, colour or depth, how it fails, where it stands.
 *
 * A board belongs to one side or to both (linked). It shows what a frame says, so that a link, a
 * schedule and a click look the same; while a slider is held, the slider is right. What breaks or
 * moves a camera is under the cards, for one camera at a time.
 */

import {intact} from './camera_state.js';
import {cameraColour} from './colours.js';
import {make, say} from './dom.js';
import {moveBox} from './moves.js';
import {cameraOf} from './streams.js';
import {gives} from './subsets.js';
import {moveWords, stateWords} from './words.js';

/** @typedef {import('./messages.js').CameraState} CameraState */
/** @typedef {import('./messages.js').Command} Command */
/** @typedef {import('./messages.js').Occlusion} Occlusion */
/** @typedef {import('./messages.js').Side} SideName */
/** @typedef {import('./catalogue.js').Entry} Entry */
/** @typedef {{state: CameraState, update: (world: import('./messages.js').World) => void,
 *   element: HTMLElement, more: HTMLButtonElement, inner: HTMLElement}} Card */

/** @type {[Occlusion['kind'], string][]} */
const FAILURES = [['none', 'its picture'], ['black', 'black'], ['noise', 'noise'],
  ['freeze', 'a frozen picture'], ['blur', 'a blurred picture'], ['patch', 'a patch in view']];
/** @type {Record<string, [keyof Occlusion, string][]>} */
const SLIDERS = {noise: [['strength', 'strength']], blur: [['strength', 'strength']],
  patch: [['x', 'across'], ['y', 'down'], ['width', 'width'], ['height', 'height']]};

/** Milliseconds in which a click stands although no frame shows it yet. */
const CONFIRM = 1000;

/** Cards have ids of their own on the page, also where both sides have theirs. */
let count = 0;

/**
 * On and off; with two modalities colour, depth, both, off: those that every policy here gets.
 * @param {Entry[]} entries
 * @param {string} camera
 * @returns {[CameraState['input'], string][]}
 */
export function choicesOf(entries, camera) {
  const several = entries.some(one =>
    one.streams.filter(stream => cameraOf(stream) === camera).length > 1);
  if (!several) return [['both', 'on'], ['off', 'off']];
  /** @type {[CameraState['input'], string][]} */
  const choices = [['rgb', 'colour'], ['depth', 'depth'], ['both', 'both'], ['off', 'off']];
  return choices.filter(([value]) => entries.every(one => gives(one.streams, camera, value)));
}

export class SwitchBoard {
  /**
   * @param {Entry[]} entries Of all sides that it acts on.
   * @param {SideName} side
   * @param {(command: Command) => void} send
   */
  constructor(entries, side, send) {
    const [entry] = entries;
    this.entries = entries;
    this.entry = entry;
    this.side = side;
    this.send = send;
    this.cards = new Map(entry.cameras.map((camera, index) => [camera.name, this.card(index)]));
    this.opened = '';
    this.drawer = make('div', {class: 'drawer', hidden: true});
    this.element = make('div', {class: 'board', 'data-side': side},
      ...[...this.cards.values()].map(card => card.element), this.drawer);
    this.element.style.setProperty('--count', String(Math.min(entry.cameras.length, 5)));
  }

  /** Shows what breaks or moves a camera, or closes it. @param {string} camera */
  turn(camera) {
    this.opened = this.opened === camera ? '' : camera;
    for (const [name, {more, inner}] of this.cards) {
      more.setAttribute('aria-expanded', String(name === this.opened));
      if (name === this.opened) this.drawer.replaceChildren(inner);
    }
    this.drawer.hidden = !this.opened;
    this.drawer.scrollIntoView({block: 'nearest'});
  }

  /** @param {import('./messages.js').World} world */
  update(world) {
    for (const card of this.cards.values()) card.update(world);
  }

  /**
   * Switches a camera off, or on again: what its key does.
   * @param {string} camera
   */
  toggle(camera) {
    const card = this.cards.get(camera);
    if (!card) return;
    this.set(camera, {...card.state, input: card.state.input === 'off' ? 'both' : 'off'});
  }

  /**
   * A box on a picture is a patch there.
   * @param {string} camera
   * @param {import('./patch_box.js').Box} box
   */
  patch(camera, box) {
    const state = this.cards.get(camera)?.state ?? intact();
    this.set(camera, {input: state.input, occlusion: {kind: 'patch', strength: 1, ...box}});
  }

  /** @param {string} camera @param {CameraState} state */
  set(camera, state) {
    this.send({kind: 'SetCamera', side: this.side, camera, state});
  }

  /** @param {number} index Of the camera. @returns {Card} */
  card(index) {
    const {name, label} = this.entry.cameras[index];
    const switches = this.inputs(name, label);
    const failure = this.failure(name, label);
    const move = moveBox(label, to =>
      this.send({kind: 'MoveCamera', side: this.side, camera: name, move: to}));
    const state = make('span', {class: 'state'});
    const inner = make('div', {class: 'inner'}, make('h3', {}, `Break or move ${label} `, state),
      failure.element, move.element);
    const more = make('button', {type: 'button', class: 'more', 'aria-expanded': 'false',
      'aria-label': `Break or move ${label}`, onclick: () => this.turn(name)}, 'break …');
    const element = make('fieldset', {class: 'card', 'data-camera': name},
      make('legend', {}, label, make('kbd', {title: `Key ${index + 1}`}, String(index + 1))),
      switches.element, ...(this.entry.recorded ? [] : [more]));
    element.style.setProperty('--c', cameraColour(index));
    inner.style.setProperty('--c', cameraColour(index));
    const card = {state: intact(), element, more, inner, update: (/** @type {any} */ world) => {
      card.state = world.cameras[name] ?? intact();
      element.classList.toggle('off', card.state.input === 'off');
      switches.update(card.state);
      move.update(world.moves[name]);
      const how = [card.state.occlusion.kind === 'none' ? '' : stateWords({...card.state,
        input: 'both'}), world.moves[name] ? moveWords(world.moves[name]) : ''].filter(Boolean);
      more.setAttribute('aria-pressed', String(how.length > 0));
      say(state, how.join(', '));
      failure.update(card.state);
    }};
    return card;
  }

  /** @param {string} camera @param {string} label */
  inputs(camera, label) {
    const choices = choicesOf(this.entries, camera);
    const group = `input-${count += 1}`;
    let asked = '';
    let since = -Infinity;
    let latest = intact();
    const radios = choices.map(([value, words]) => {
      const radio = make('input', {type: 'radio', name: group, value, onchange: () => {
        asked = value;
        since = performance.now();
        this.set(camera, {...this.stateOf(camera), input: value});
      }});
      return {radio, label: make('label', {}, radio, make('span', {}, words))};
    });
    const kind = choices.length > 2 ? 'segments long' : 'segments';
    const element = make('div', {class: kind, role: 'radiogroup', 'aria-label': label},
      ...radios.map(one => one.label));
    /** @param {CameraState} state */
    const update = state => {
      const shown = choices.some(([value]) => value === state.input) ? state.input : 'both';
      latest = state;
      // A frame that was on its way when a visitor clicked shows what was before.
      if (shown !== asked && performance.now() - since < CONFIRM) {
        setTimeout(() => update(latest), CONFIRM);
        return;
      }
      since = -Infinity;
      for (const {radio} of radios) radio.checked = radio.value === shown;
    };
    return {element, update};
  }

  /** @param {string} camera */
  stateOf(camera) {
    return this.cards.get(camera)?.state ?? intact();
  }

  /** What the camera sends, and the sliders of that. @param {string} camera @param {string} label */
  failure(camera, label) {
    const select = make('select', {'aria-label': `What ${label} sends`, onchange: () => {
      const kind = /** @type {Occlusion['kind']} */ (select.value), state = this.stateOf(camera);
      const input = state.input === 'off' ? 'both' : state.input; // Else nothing would be seen.
      this.set(camera, {input, occlusion: {...intact().occlusion, kind}});
    }}, ...FAILURES.map(([kind, words]) => make('option', {value: kind}, words)));
    const box = make('div', {class: 'sliders'});
    const element = make('div', {class: 'failure'},
      make('label', {}, make('span', {}, 'sends'), select), box);
    /** @type {Map<string, HTMLInputElement>} */
    let sliders = new Map();
    let kind = '';
    /** @param {CameraState} state */
    const update = state => {
      if (document.activeElement !== select) select.value = state.occlusion.kind;
      if (state.occlusion.kind !== kind) {
        kind = state.occlusion.kind;
        sliders = this.sliders(camera, label, kind);
        box.replaceChildren(...[...sliders.values()].map(one =>
          make('label', {}, make('span', {}, one.dataset.words ?? ''), one)));
        if (this.drawer.contains(box)) this.drawer.scrollIntoView({block: 'nearest'});
      }
      for (const [name, slider] of sliders) {
        if (document.activeElement !== slider) {
          slider.value = String(state.occlusion[/** @type {keyof Occlusion} */ (name)]);
        }
      }
    };
    return {element, update};
  }

  /** @param {string} camera @param {string} label @param {string} kind
   * @returns {Map<string, HTMLInputElement>} */
  sliders(camera, label, kind) {
    return new Map((SLIDERS[kind] ?? []).map(([name, words]) => {
      const slider = make('input', {type: 'range', min: 0, max: 1, step: 0.05,
        'data-words': words, 'aria-label': `${label}: ${words}`, oninput: () => {
          const state = this.stateOf(camera);
          const occlusion = {...state.occlusion, [name]: Number(slider.value)};
          this.set(camera, {...state, occlusion});
        }});
      return [name, slider];
    }));
  }
}
