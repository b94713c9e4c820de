/** Who plays and how: policies, the seed, play and pause, speed, and the rate that is reached. */

import {make, say} from './dom.js';

/** @typedef {import('./messages.js').Command} Command */
/** @typedef {import('./messages.js').Frame} Frame */
/** @typedef {import('./catalogue.js').Catalogue} Catalogue */
/** @typedef {import('./catalogue.js').Entry} Entry */

/** @type {[string, string][]} */
const SPEEDS = [['1', '1 a second'], ['2', '2 a second'], ['5', '5 a second'],
  ['10', '10 a second'], ['20', '20 a second'], ['', 'full speed']];

export class Transport {
  /**
   * @param {Catalogue} catalogue
   * @param {(command: Command) => void} send
   * @param {(change: {policy?: string, vs?: string | null}) => void} onChoice
   */
  constructor(catalogue, send, onChoice) {
    this.catalogue = catalogue;
    this.phase = '';
    this.who = make('select', {id: 'who', onchange: () => onChoice({policy: this.who.value})},
      ...catalogue.groups().map(group => make('optgroup', {label: group.label},
        ...group.entries.map(one => make('option', {value: one.name}, nameOf(one))))));
    this.rival = make('select', {id: 'rival', onchange: () =>
      onChoice({vs: this.rival.value || null})});
    this.seed = make('select', {id: 'seed', onchange: () =>
      send({kind: 'SetSeed', seed: Number(this.seed.value)})});
    this.play = make('button', {type: 'button', class: 'play', onclick: () => this.toggle(send)});
    this.speed = make('select', {id: 'speed', onchange: () => send({kind: 'SetSpeed',
      rate: this.speed.value === '' ? null : Number(this.speed.value)})},
    ...SPEEDS.map(([value, words]) => make('option', {value}, words)));
    this.auto = make('input', {type: 'checkbox', 'aria-label': 'Start the next seed by itself',
      onchange: () =>
      send({kind: 'SetAutoNext', on: this.auto.checked})});
    const button = (/** @type {string} */ words, /** @type {Command} */ command) =>
      make('button', {type: 'button', onclick: () => send(command)}, words);
    this.element = make('div', {class: 'transport'},
      field('Policy', this.who), field('vs', this.rival), field('Seed', this.seed),
      make('span', {class: 'group'}, this.play, button('Step', {kind: 'StepOnce'}),
        button('Again', {kind: 'Reset', next_seed: false}),
        button('Next seed', {kind: 'Reset', next_seed: true})),
      field('Decisions', this.speed), make('label', {class: 'check'}, this.auto, 'go on'));
  }

  /** Fills what depends on who acts. @param {Entry} entry @param {Entry | null} rival */
  show(entry, rival) {
    this.who.value = entry.name;
    this.rival.replaceChildren(make('option', {value: ''}, 'nobody'),
      ...this.catalogue.rivals(entry).map(one =>
        make('option', {value: one.name}, one.label)));
    this.rival.value = rival?.name ?? '';
    this.rival.disabled = this.rival.options.length < 2;
    this.seed.replaceChildren(...entry.seeds.map(seed =>
      make('option', {value: seed}, String(seed))));
  }

  /** @param {(command: Command) => void} send */
  toggle(send) {
    if (this.phase === 'ended') send({kind: 'Reset', next_seed: false});
    send({kind: this.phase === 'playing' ? 'Pause' : 'Play'});
  }

  /** @param {Frame} frame */
  update(frame) {
    this.phase = frame.phase;
    say(this.play, {playing: 'Pause', paused: 'Play', ended: 'Play again',
      running: 'Running'}[frame.phase]);
    this.play.disabled = frame.phase === 'running';
    if (document.activeElement !== this.seed) this.seed.value = String(frame.first.seed);
    if (document.activeElement !== this.speed) {
      this.speed.value = frame.speed === null ? '' : String(frame.speed);
    }
    this.auto.checked = frame.auto_next;
  }
}

/**
 * The rate that is reached, and whether this machine is behind.
 * @param {Frame} frame
 */
export function rateNow({phase, rate, speed}) {
  if (phase !== 'playing' || !Number.isFinite(rate)) return '';
  const behind = speed !== null && rate < 0.85 * speed;
  return behind ? `${rate.toFixed(1)} decisions a second: this machine is slower than asked`
    : `${rate.toFixed(1)} decisions a second`;
}

/** @param {Entry} entry */
function nameOf(entry) {
  return `${entry.label} · ${entry.task_label}`;
}

/** @param {string} words @param {HTMLElement} control */
function field(words, control) {
  return make('label', {class: 'field'}, make('span', {}, words), control);
}
