/**
 * The page as a whole: who is shown, which frame is the newest, and what goes where.
 *
 * Answers come from the engine; each panel draws what a frame holds. Pictures follow every frame,
 * panels four times a second. The opening shows less and sets its own switches; `explore` has all.
 */

import {intact} from './camera_state.js';
import {byId, make, say} from './dom.js';
import {answersFor, endingOf} from './ending.js';
import {mergedEvents} from './link.js';
import {notice} from './notices.js';
import {SPEED, acts, endingNodes, headline, leadsOn, openingEvents, story, tell} from './opening.js';
import {Features, Subsets} from './readout.js';
import {SceneView} from './scene_view.js';
import {Side} from './side.js';
import {Tally} from './statistics.js';
import {gives} from './subsets.js';
import {RunMany, Success} from './success.js';
import {SwitchBoard} from './switches.js';
import {Timeline} from './timeline.js';
import {Transport, rateNow} from './transport.js';
import {changeWords, guardWords} from './words.js';

/** @typedef {import('./messages.js').CameraState} CameraState */
/** @typedef {import('./messages.js').Command} Command */
/** @typedef {import('./messages.js').Frame} Frame */
/** @typedef {import('./messages.js').World} World */
/** @typedef {import('./catalogue.js').Catalogue} Catalogue */
/** @typedef {import('./catalogue.js').Entry} Entry */
/** @typedef {import('./catalogue.js').Scene} Scene */

const PANELS = 250; // Milliseconds between two drawings of tables and curves.
const EPISODES = 20;

export class Explorer {
  /**
   * @param {Catalogue} catalogue
   * @param {(command: Command) => void} send
   * @param {(change: {policy?: string, vs?: string | null}) => void} onChoice
   * @param {() => void} onOpening Plays the first scene from its beginning.
   */
  constructor(catalogue, send, onChoice, onOpening) {
    this.catalogue = catalogue;
    this.send = send;
    this.onOpening = onOpening;
    /** The switches of the schedule that runs, for a link. @type {import('./link.js').LinkEvent[]} */
    this.planned = [];
    /** @type {'loading' | 'opening' | 'explore'} */
    this.mode = 'loading';
    /** @type {Frame | null} */
    this.frame = null;
    this.tally = new Tally();
    this.linked = true;
    /** @type {Entry[]} */
    this.entries = [];
    /** @type {Side[]} */
    this.sides = [];
    /** @type {SwitchBoard[]} */
    this.boards = [];
    /** @type {{features: Features, subsets: Subsets, success: Success}[]} */
    this.panels = [];
    this.view = new SceneView(notice);
    this.timeline = new Timeline(byId('timeline'));
    this.transport = new Transport(catalogue, send, onChoice);
    byId('choose').replaceChildren(this.transport.element);
    this.many = new RunMany(EPISODES, send);
    this.linkButtons = [true, false].map(linked => make('button', {type: 'button',
      onclick: () => this.choose(linked)}, linked ? 'A and B' : 'one side'));
    this.link = make('div', {class: 'field', role: 'group', 'aria-label': 'Switches act on'},
      make('span', {}, 'Switches act on'), ...this.linkButtons);
    this.guard = make('input', {type: 'checkbox', onchange: () => {
      this.planned = this.planned.filter(one => one.guard === undefined);
      this.send({kind: 'SetGuard', on: this.guard.checked});
    }});
    this.drawn = 0;
    /** Of the opening. */
    this.act = 0;
    this.asked = false;
    /** Whether a guess is asked for; the opening waits for it. */
    this.asks = false;
    /** Whether the first act stands still, for a visitor who wants little to move. */
    this.waits = false;
    /** Whether the visitor wants no more questions. */
    this.silent = false;
    /** Who will succeed in an episode, as the visitor thinks; '' where nobody guessed. */
    this.guess = {words: '', episode: 0};
    /** What the page waits for; the episode before stands still meanwhile. */
    this.awaited = '';
  }

  /** @param {'loading' | 'opening' | 'explore'} mode */
  setMode(mode) {
    this.mode = mode;
    document.body.dataset.mode = mode;
    const shown = {loading: ['loading'], opening: ['story', 'timeline'],
      explore: ['story', 'choose', 'timeline', 'controls', 'inside']}[mode];
    for (const id of ['loading', 'story', 'choose', 'timeline', 'controls', 'inside']) {
      byId(id).hidden = !shown.includes(id);
    }
    this.headline();
  }

  /** Says what the page waits for. @param {string} words '' where it waits no more. */
  waitFor(words) {
    if (words === this.awaited) return;
    this.awaited = words;
    if (this.frame) this.words(this.frame, worldsOf(this.frame));
  }

  headline() {
    if (this.entries.length === 0) return;
    const title = byId('headline'), turn = byId('turn');
    const button = (/** @type {string} */ words, /** @type {() => void} */ act, main = false) =>
      make('button', {type: 'button', class: main ? 'main' : '', onclick: act}, words);
    const answers = this.asks ? [...answersFor(this.entries).map(guess =>
      button(guess, () => this.answer(guess))),
    button('Just show me', () => this.answer(''), this.mode === 'opening')] : [];
    if (this.mode === 'opening') {
      const opening = this.catalogue.opening(), all = acts(opening), next = all[this.act + 1];
      say(title, headline(opening, all[this.act]));
      turn.replaceChildren(...answers, ...this.asks ? []
        : [...this.waits ? [button('Play', () => this.again(), true)] : [],
          ...next ? [button(leadsOn(opening, next), () => this.again(this.act + 1), !this.waits)] : [],
          button('Your turn', () => this.yourTurn(), !next),
          button('Again', () => this.again())]);
    } else {
      say(title, this.entries[1] ? `${this.entries[0].label} and ${this.entries[1].label}: `
        + `${this.entries[0].task_label}` : `${this.entries[0].label}: ${this.entries[0].task_label}`);
      turn.replaceChildren(...answers, ...this.asks ? []
        : [button('Show me first', () => this.onOpening())]);
    }
  }

  /** An act of the opening from its beginning. @param {number} [number] */
  again(number = this.act) {
    this.act = number;
    this.waits = false;
    const opening = this.catalogue.opening(), act = acts(opening)[number];
    this.whole();
    this.send({kind: 'SetGuard', on: act.guard});
    this.planned = openingEvents(opening, act);
    this.send({kind: 'SetSchedule', events: this.planned});
    this.send({kind: 'SetSpeed', rate: SPEED});
    this.send({kind: 'SetSeed', seed: opening.seed});
    this.ask(act.asks);
    this.send({kind: this.asks ? 'Pause' : 'Play'});
  }

  /**
   * The opening stands at its first step until the visitor has guessed, or wants to see it.
   * @param {boolean} asks Whether there are two to guess between.
   */
  ask(asks) {
    this.asks = asks;
    this.guess = {words: '', episode: 0};
    this.headline();
  }

  /** @param {string} guess '' for none, and for no more questions. */
  answer(guess) {
    this.asks = false;
    this.silent ||= !guess;
    this.guess = {words: guess, episode: this.frame?.first.episode ?? 0};
    this.headline();
    if (this.mode === 'opening') this.send({kind: 'Play'});
    else if (this.frame) this.words(this.frame, worldsOf(this.frame)); // No frame may come.
  }

  /** Asks who will still succeed where a camera has just gone off; nothing waits. @param {World} world */
  wonder({change, cameras, ended, episode}) {
    const dropped = change !== null && cameras[change.camera]?.input === 'off';
    const asks = dropped && !ended && !this.silent && this.guess.episode !== episode;
    if (asks === this.asks) return;
    this.asks = asks;
    this.headline();
  }

  /** All cameras work. */
  whole() {
    for (const camera of this.entries[0]?.cameras ?? []) {
      this.send({kind: 'SetCamera', side: 'both', camera: camera.name, state: intact()});
    }
  }

  /** The visitor has the switches. */
  yourTurn() {
    this.planned = [];
    this.send({kind: 'SetSchedule', events: []});
    this.send({kind: 'SetGuard', on: false});
    this.whole();
    this.send({kind: 'Reset', next_seed: false});
    this.send({kind: 'Play'});
    this.setMode('explore');
    byId('controls').querySelector('input')?.focus({preventScroll: true});
  }

  /** The switches that come by themselves. @param {import('./link.js').LinkEvent[]} events */
  plan(events) {
    this.planned = events;
    if (events.some(one => one.side !== 'both')) this.setLinked(false);
  }

  /** @param {boolean} linked Whether a switch acts on both sides. */
  setLinked(linked) {
    this.linked = linked;
    if (this.entries.length) this.arrange();
  }

  /** What the visitor wants. Switches that act on both sides begin with sides that are alike.
   * @param {boolean} linked */
  choose(linked) {
    this.setLinked(linked);
    const {first, second} = this.frame ?? {};
    if (!linked || !first || !second) return;
    /** Whether both get it. @param {string} camera @param {CameraState} [state] */
    const given = (camera, state) => !state
      || this.entries.every(one => gives(one.streams, camera, state.input));
    if (this.planned.some(one => one.side !== 'both')) {
      this.planned = this.planned
        .filter(one => one.side !== 'second' && given(one.camera, one.state))
        .map(one => ({...one, side: /** @type {const} */ ('both')}));
      this.send({kind: 'SetSchedule', events: this.planned});
    }
    const side = /** @type {const} */ ('second');
    for (const {name: camera} of this.entries[0].cameras) {
      let state = first.cameras[camera];
      const move = first.moves[camera] ?? null;
      if (!given(camera, state)) {
        state = {...state, input: 'both'};
        this.send({kind: 'SetCamera', side: 'first', camera, state});
      }
      if (differ(state, second.cameras[camera])) this.send({kind: 'SetCamera', side, camera, state});
      if (differ(move, second.moves[camera] ?? null)) {
        this.send({kind: 'MoveCamera', side, camera, move});
      }
    }
  }

  /** Builds what depends on who acts. */
  arrange() {
    const [entry, rival] = this.entries, two = this.entries.length > 1;
    document.body.dataset.sides = two ? '2' : '1';
    this.sides = this.entries.map((one, index) => {
      const name = index === 0 ? /** @type {const} */ ('first') : /** @type {const} */ ('second');
      const side = this.sides[index] ?? this.newSide(name);
      side.show(one);
      return side;
    });
    byId('stage').replaceChildren(...this.sides.map(side => side.element));
    const linked = two && this.linked;
    this.boards = linked || !two ? [new SwitchBoard(this.entries, 'both', this.send)]
      : this.entries.map((one, index) =>
        new SwitchBoard([one], index === 0 ? 'first' : 'second', this.send));
    this.linkButtons.forEach((button, i) => button.setAttribute('aria-pressed', String(linked === !i)));
    const titles = this.boards.map((board, index) => linked || !two ? [board.element]
      : [make('h3', {}, `Side ${'AB'[index]}: ${this.entries[index].label}`), board.element]);
    byId('controls').replaceChildren(make('div', {class: 'heading'}, make('h2', {}, 'Cameras'),
      ...(two ? [this.link] : []), make('span', {class: 'soft'},
        'Off: it leaves the sum. Anything else: it stays, and sends that.')),
    make('div', {class: 'boards'}, ...titles.flat()), ...entry.recorded ? [] : [this.guardBox()]);
    this.panels = this.entries.map(one => ({features: new Features(one),
      subsets: new Subsets(one), success: new Success(one, this.tally)}));
    byId('inside').replaceChildren(...this.panels.map((panel, index) => make('div',
      {class: 'column'}, make('div', {class: 'heading'}, make('h2', {},
        two ? `${'AB'[index]}: ${this.entries[index].label}` : 'Measurements'),
      ...(index === 0 && !entry.recorded ? [this.many.element] : [])),
      panel.success.element, panel.subsets.element, panel.features.element)));
    this.transport.show(entry, rival ?? null);
    this.headline();
  }

  /** The switch of the guard, and what it does or why it cannot be had. */
  guardBox() {
    const fitted = this.entries.filter(one => one.guard).length;
    const without = this.entries.find(one => !one.guard);
    this.guard.disabled = !fitted;
    return make('p', {class: 'guard'}, make('label', {}, this.guard, ' Guard'),
      make('span', {class: 'soft'}, fitted === this.entries.length
        ? 'A camera that fails is noticed and left out, until it works again.'
        : `No guard is fitted for ${without?.name}; madviz guard --policy ${without?.name} does it.`));
  }

  /** @param {'first' | 'second'} name */
  newSide(name) {
    const side = new Side(name, (camera, box) => {
      const board = this.boards.find(one => one.side === 'both' || one.side === name);
      board?.patch(camera, box);
    });
    this.view.listen(side.canvas);
    return side;
  }

  /** @param {Frame} frame */
  take(frame) {
    const worlds = worldsOf(frame), names = worlds.map(world => world.policy);
    if (names.join() !== this.entries.map(one => one.name).join()) {
      const entries = names.map(name => this.catalogue.find(name));
      if (entries.some(one => !one)) return;
      this.entries = /** @type {Entry[]} */ (entries);
      this.arrange();
    }
    this.frame = frame;
    worlds.forEach((world, index) => this.panels[index].features.add(world));
    this.timeline.add(frame);
    for (const outcome of frame.outcomes) this.tally.add(outcome);
    if (!this.asked) {
      this.asked = true;
      requestAnimationFrame(() => { this.asked = false; this.draw(); });
    }
  }

  draw() {
    const {frame} = this;
    if (!frame) return;
    const worlds = worldsOf(frame);
    worlds.forEach((world, index) => this.sides[index]?.update(world));
    for (const board of this.boards) {
      board.update(board.side === 'second' && frame.second ? frame.second : frame.first);
    }
    this.guard.checked = worlds.some(world => world.guard);
    this.transport.update(frame);
    this.view.show(worlds.map((world, index) => ({world, side: this.sides[index]})));
    const now = performance.now();
    if (now - this.drawn < PANELS && frame.phase === 'playing') return;
    this.drawn = now;
    this.words(frame, worlds);
    this.timeline.draw(frame, this.entries[0], rateNow(frame));
    if (this.mode !== 'explore') return;
    worlds.forEach((world, index) => {
      const {features, subsets, success} = this.panels[index];
      features.draw(world);
      subsets.draw(world);
      success.draw(world);
    });
  }

  /** The line that says what has just happened. @param {Frame} frame @param {World[]} worlds */
  words(frame, worlds) {
    const line = byId('line');
    if (this.awaited) return tell(line, [document.createTextNode(this.awaited)]);
    if (this.mode === 'opening') {
      const {words, episode} = this.guess;
      return tell(line, story(frame, this.catalogue.opening(), this.tally,
        {asks: this.asks, guess: episode === frame.first.episode ? words : ''},
        acts(this.catalogue.opening())[this.act]));
    }
    this.wonder(frame.first);
    const guess = this.guess.episode === frame.first.episode ? this.guess.words : '';
    const noticed = worlds.map((world, index) => guardWords(world, this.entries[index].cameras));
    const guard = [...new Set(noticed.filter(Boolean))].join(' ');
    const ending = endingNodes(endingOf(worlds, this.entries, this.tally), guess);
    if (ending.length) return tell(line, [...ending, document.createTextNode(guard && ` ${guard}`)]);
    const changes = worlds.map((world, index) => world.change && world.step - world.change.step < 40
      ? `${worlds.length > 1 ? `${this.entries[index].label}: ` : ''}${
        changeWords(world.change, this.entries[index].cameras)}` : '').filter(Boolean);
    const hint = this.entries[0].recorded
      ? 'Recorded episodes: a switch goes over to the episode without that camera.'
      : `Switch a camera off, break its picture, or drag a box over it.${
        matchMedia('(pointer: fine)').matches
          ? ` Keys 1 to ${this.entries[0].cameras.length} switch one off.` : ''}`;
    const said = [changes.join('. '), guard].filter(Boolean).join('. ');
    const asked = !this.asks ? guess && ` You say ${guess}.`
      : worlds.length > 1 ? ' Which will still do it?' : ' Will it still do it?';
    const stop = asked && /[^.]$/.test(said) ? '.' : '';
    const nodes = [document.createTextNode(said ? said + stop : hint)];
    return tell(line, asked ? [...nodes, make('b', {}, asked)] : nodes);
  }

  /** What is played now, for a link. @returns {import('./link.js').LinkState | null} */
  state() {
    if (!this.frame || this.mode === 'loading') return null;
    const {first, second} = this.frame;
    return {policy: first.policy, vs: second?.policy ?? null, seed: first.seed,
      events: [...mergedEvents(first.events, second?.events ?? null),
        ...this.planned.filter(event => event.step > first.step)]
        .filter(event => event.step < first.horizon)}; // A later one changes no decision.
  }
}

/** @param {unknown} one @param {unknown} other */
function differ(one, other) {
  return JSON.stringify(one) !== JSON.stringify(other);
}

/** @param {Frame} frame @returns {World[]} */
function worldsOf(frame) {
  return frame.second ? [frame.first, frame.second] : [frame.first];
}
