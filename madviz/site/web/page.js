/** Where the page begins: what this browser can do, what the site offers, what a link asks for. */

import {Catalogue} from './catalogue.js';
import {byId, calm, make, say} from './dom.js';
import {BASE, missing, startEngine} from './engine.js';
import {Explorer} from './explorer.js';
import {fetchManifest} from './files.js';
import {formatLink, parseLink} from './link.js';
import {notice} from './notices.js';
import {SPEED, acts, openingEvents} from './opening.js';
import {Standstill} from './standstill.js';
import {megabytes} from './words.js';

/** @typedef {import('./messages.js').Answer} Answer */
/** @typedef {import('./messages.js').Command} Command */
/** @typedef {import('./catalogue.js').Scene} Scene */

const LONGEST = 4_000_000; // Bytes of a session file.

class Page {
  /** @param {import('./messages.js').Manifest} manifest @param {boolean} alive */
  constructor(manifest, alive) {
    this.manifest = manifest;
    this.catalogue = new Catalogue(manifest, alive);
    this.alive = alive;
    /** @type {import('./engine.js').Engine | null} */
    this.engine = null;
    this.recorded = false;
    /** The one that acts live, also while recordings play: it has the episodes that *Save* writes.
     * @type {import('./engine.js').Engine | null} */
    this.live = null;
    this.ready = false;
    /** Ends what the page listens to. */
    this.left = new AbortController();
    /** @type {Standstill | null} */
    this.standstill = null;
    this.explorer = new Explorer(this.catalogue, command => this.engine?.post(command),
      change => this.choose(change), () => this.opening());
    this.ownHash = '';
    /** @type {'opening' | 'explore'} */
    this.mode = 'explore';
  }

  /** Plays what the address asks for; without anything, the opening. */
  follow() {
    const {state, problems} = parseLink(location.hash);
    const asked = state.policy || state.events.length || state.seed !== null;
    problems.forEach(words => notice(words));
    if (!asked) this.opening();
    else {
      const checked = this.catalogue.checked(state);
      checked.problems.forEach(words => notice(words));
      this.play(checked.scene, 'explore');
    }
  }

  /** The first scene, by an engine that acts live if there is one. */
  opening() {
    const opening = this.catalogue.opening(), [first, second] = opening.entries;
    this.play({policy: first.name, vs: second?.name ?? null, seed: opening.seed,
      events: openingEvents(opening, acts(opening)[0])}, 'opening');
  }

  /**
   * Starts an engine where there is none of the right kind, and plays a scene from its beginning.
   * @param {Scene} scene
   * @param {'opening' | 'explore'} mode
   */
  play(scene, mode) {
    const recorded = this.catalogue.find(scene.policy)?.recorded ?? false;
    if (!this.engine || this.recorded !== recorded) {
      if (recorded) this.live?.post({kind: 'StopRun'});
      if (recorded) this.live?.post({kind: 'Pause'});
      else this.engine?.stop();
      this.recorded = recorded;
      this.ready = false;
      this.explorer.setMode('loading');
      this.explorer.many.reset();
      this.standstill?.end();
      this.standstill = new Standstill(words => say(byId('loading-words'), words));
      this.engine = recorded ? this.started(true) : this.live ?? this.started(false);
      if (!recorded) this.live = this.engine;
    }
    this.mode = mode;
    if (this.ready) this.explorer.waitFor(`Loading ${this.catalogue.find(scene.policy)?.label} …`);
    this.engine.post({kind: 'Open', base: BASE, policy: scene.policy, seed: scene.seed,
      second: scene.vs, events: scene.events});
    this.engine.post({kind: 'SetSpeed', rate: SPEED});
    const asks = mode === 'opening' && acts(this.catalogue.opening())[0].asks;
    this.explorer.act = 0;
    this.explorer.waits = mode === 'opening' && calm() && !asks;
    this.explorer.ask(asks);
    this.engine.post({kind: calm() || asks ? 'Pause' : 'Play'});
    if (this.ready) this.explorer.setMode(mode);
  }

  /** An engine to whose answers the page listens while it is the one that plays.
   * @param {boolean} recorded @returns {import('./engine.js').Engine} */
  started(recorded) {
    const engine = startEngine(recorded, this.manifest, answer => {
      if (this.engine === engine) this.answer(answer);
    });
    return engine;
  }

  /** @param {{policy?: string, vs?: string | null}} change From the lists of policies. */
  choose(change) {
    const frame = this.explorer.frame;
    if (!frame) return;
    const entry = this.catalogue.find(change.policy ?? frame.first.policy);
    if (!entry) return;
    const wanted = change.vs === undefined ? frame.second?.policy ?? null : change.vs;
    const rival = this.catalogue.rivals(entry).find(one => one.name === wanted);
    const seed = entry.seeds.includes(frame.first.seed) ? frame.first.seed : entry.seeds[0];
    this.play({policy: entry.name, vs: rival?.name ?? null, seed, events: []}, 'explore');
  }

  /** @param {Answer} answer */
  answer(answer) {
    const {explorer} = this;
    switch (answer.kind) {
      case 'Progress':
        this.standstill?.note(answer.done < answer.of);
        return progress(answer);
      case 'Ready':
        this.ready = true;
        explorer.plan(answer.events);
        this.standstill?.end();
        explorer.waitFor('');
        explorer.setMode(this.mode);
        document.body.dataset.ready = 'true';
        return undefined;
      case 'Frame':
        explorer.take(answer);
        return undefined;
      case 'Scene': return explorer.view.addScene(answer.task, answer.buffer, answer.textures);
      case 'Run':
        answer.outcomes.forEach(outcome => explorer.tally.add(outcome));
        return explorer.many.update(answer);
      case 'Saved':
        if (explorer.entries.length > 1) {
          notice('The file has the episodes of side A. Copy link keeps both sides.');
        }
        return download(answer.text);
      case 'Problem': return this.problem(answer);
      default: return undefined;
    }
  }

  /** @param {import('./messages.js').Problem} problem */
  problem(problem) {
    const films = this.manifest.recordings.length > 0;
    this.standstill?.end();
    this.explorer.waitFor('');
    if (problem.refused && films && this.alive) {
      notice(`${problem.message} What follows are recorded episodes.`);
      return showRecordings(this.manifest, this);
    }
    notice(problem.message, problem.fatal && films && this.alive
      ? {words: 'Show recorded episodes', act: () => showRecordings(this.manifest, this)} : undefined);
    if (!this.ready) say(byId('loading-words'), problem.message);
    const [first, second] = this.explorer.entries; // The lists name the policies that act.
    if (first) this.explorer.transport.show(first, second ?? null);
    return undefined;
  }

  /** Writes the present state into the address, so that it can be copied at any time. */
  remember() {
    const state = this.explorer.mode === 'explore' && this.explorer.state();
    if (!state) return;
    const hash = formatLink(state);
    if (hash === this.ownHash) return;
    this.ownHash = hash;
    history.replaceState(null, '', hash);
  }

  listen() {
    const {signal} = this.left;
    addEventListener('hashchange', () => {
      if (location.hash !== this.ownHash) this.follow();
    }, {signal});
    // The address is the episode's; a link to a place in the page must not change it.
    document.querySelector('.skip')?.addEventListener('click', event => {
      event.preventDefault();
      byId('stage').focus();
    }, {signal});
    const timer = setInterval(() => this.remember(), 1000); // Browsers refuse much more than that.
    signal.addEventListener('abort', () => clearInterval(timer));
    document.addEventListener('visibilitychange', () => {
      this.engine?.post({kind: 'SetVisible', on: !document.hidden});
      this.explorer.view.wake();
    }, {signal});
    addEventListener('keydown', event => this.key(event), {signal});
  }

  /** @param {KeyboardEvent} event */
  key(event) {
    const target = /** @type {HTMLElement} */ (event.target);
    if (event.ctrlKey || event.metaKey || event.altKey || this.explorer.mode !== 'explore') return;
    if (target.closest('select, textarea, input:not([type=radio], [type=checkbox])')) return;
    const {explorer} = this, post = (/** @type {Command} */ one) => this.engine?.post(one);
    if (event.key === ' ' && target.closest('button, summary, input')) return;
    if (/^[1-9]$/.test(event.key)) {
      const camera = explorer.entries[0]?.cameras[Number(event.key) - 1];
      if (camera) explorer.boards.forEach(board => board.toggle(camera.name));
    } else if (event.key === ' ') explorer.transport.toggle(post);
    else if (event.key === 'r') post({kind: 'Reset', next_seed: false});
    else if (event.key === 'n') post({kind: 'Reset', next_seed: true});
    else if (event.key === 's') post({kind: 'StepOnce'});
    else return;
    event.preventDefault();
  }

  /** The buttons at the top. */
  tools() {
    const copy = make('button', {type: 'button', onclick: () => this.copy(copy)}, 'Copy link');
    const save = make('button', {type: 'button', onclick: () =>
      this.engine?.post({kind: 'Save'})}, 'Save');
    const file = make('input', {type: 'file', accept: '.json,application/json', class: 'unseen',
      'aria-label': 'Open a saved session', onchange: () => this.open(file)});
    const open = make('label', {class: 'button'}, 'Open', file);
    byId('tools').replaceChildren(copy, save, open);
    if (document.body.classList.contains('embed')) {
      const whole = make('a', {class: 'button', target: '_blank', href: location.pathname,
        rel: 'noopener', onclick: () => { whole.href = location.pathname + this.hash(); }},
      'Open the whole page');
      byId('tools').replaceChildren(whole);
    }
  }

  /** The present state as the end of an address; '' where nothing plays yet. */
  hash() {
    const state = this.explorer.state();
    return state ? formatLink(state) : '';
  }

  /** @param {HTMLButtonElement} button */
  async copy(button) {
    const address = new URL(this.hash(), location.href).href;
    try {
      await navigator.clipboard.writeText(address);
      say(button, 'Copied');
      setTimeout(() => say(button, 'Copy link'), 1500);
    } catch { // Not allowed here, as in some frames: the visitor copies it.
      prompt('This link plays the same episode:', address);
    }
  }

  /** @param {HTMLInputElement} input */
  async open(input) {
    const file = input.files?.[0];
    input.value = '';
    if (!file) return;
    if (file.size > LONGEST) {
      notice(`${file.name} has more than ${megabytes(LONGEST)}, so it is no saved session.`);
      return;
    }
    const text = await file.text();
    this.mode = 'explore';
    this.explorer.waitFor(`Opening ${file.name} …`);
    this.engine?.post({kind: 'Replay', text});
  }
}

/** @param {import('./messages.js').Progress} answer */
function progress({what, done, of}) {
  const bar = /** @type {HTMLProgressElement} */ (byId('bar'));
  if (of > 0) bar.value = Math.min(done / of, 1);
  say(byId('loading-words'), of > 0
    ? `${what}: ${megabytes(done)} of ${megabytes(of)}` : what);
}

/** @param {string} text */
function download(text) {
  const address = URL.createObjectURL(new Blob([text], {type: 'application/json'}));
  make('a', {href: address, download: 'madviz-session.json'}).click();
  setTimeout(() => URL.revokeObjectURL(address), 10_000);
}

/**
 * The same page from recordings alone.
 * @param {import('./messages.js').Manifest} manifest
 * @param {Page} [before]
 */
function showRecordings(manifest, before) {
  before?.engine?.stop();
  before?.left.abort();
  start(new Page(manifest, false));
}

/** @param {Page} page */
function start(page) {
  page.tools();
  page.listen();
  page.follow();
}

/** Starts the page; what goes wrong is said on it. */
export async function main() {
  try {
    await begin();
  } catch (error) {
    say(byId('loading-words'), 'Nothing can be shown.');
    notice(`${error instanceof Error ? error.message : error} Load the page again, or try another `
      + 'browser.');
  }
}

async function begin() {
  if (new URLSearchParams(location.search).has('embed')) document.body.classList.add('embed');
  say(byId('loading-words'), 'Asking what this site offers …');
  const standstill = new Standstill(words => say(byId('loading-words'), words));
  const manifest = await fetchManifest(BASE).finally(() => standstill.end());
  say(byId('made'), `Made with madviz ${manifest.version}.`);
  const lack = missing();
  if (lack && manifest.recordings.length === 0) throw new Error(lack);
  if (lack) notice(`${lack} What follows are recorded episodes.`);
  start(new Page(manifest, !lack));
}
