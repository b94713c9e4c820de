/**
 * Episodes of one or two simulations in lock-step, one after another or many in a row.
 */
import {covers} from './camera_state.js';
import {Drawing} from './drawing.js';
import {buffersOf, Pace} from './pace.js';
import {refusal} from './refusals.js';
import {Retrace} from './retrace.js';
import {savedEpisode} from './saved.js';

/** @typedef {import('./messages.js').Answer} Answer */
/** @typedef {import('./messages.js').Outcome} Outcome */
/** @typedef {import('./messages.js').ScheduledEvent} ScheduledEvent */
/** @typedef {import('./simulation.js').Simulation} Simulation */
/** @typedef {{done: number, of: number, outcomes: Outcome[], shown: number}} Many */

/** Milliseconds between frames while many episodes are played. */
const RARELY = 500;
const MOST_OUTCOMES = 200;
const LOST = 'The graphics driver took the pictures away. The simulation goes on when they are back.';
export const MOST_SAVED = 100;

export class Episodes {
  /** @param {(answer: Answer, buffers?: Transferable[]) => void} say */
  constructor(say) {
    this.say = say;
    /** @type {Simulation[]} */
    this.sides = [];
    /** @type {ScheduledEvent[]} */
    this.schedule = [];
    /** @type {Outcome[]} */
    this.outcomes = [];
    /** As files have them. @type {object[]} */
    this.episodes = [];
    /** @type {Many | null} */
    this.many = null;
    /** Of the sides of an ended episode. @type {Retrace[]} */
    this.retraces = [];
    this.drawing = new Drawing(() => this.problem(LOST));
    this.pace = new Pace();
    this.phase = 'paused';
    this.autoNext = this.guarded = false;
    this.readEvery = 5;
    this.number = this.episode = 0;
    this.endedAt = NaN;
  }

  get seed() {
    return this.sides[0].seed;
  }

  seeds() {
    return this.sides[0].task.said.seeds;
  }

  nextSeed() {
    const seeds = this.seeds();
    return seeds[(seeds.indexOf(this.seed) + 1) % seeds.length];
  }

  /** @param {number} seed */
  async begin(seed) {
    this.episode += 1;
    for (const one of this.retraces) one.leave();
    this.retraces = [];
    for (const [i, one] of this.sides.entries()) {
      const first = this.scheduled(i, 0);
      one.restore(this.schedule.filter(event => covers(event.side, i)));
      one.episode = this.episode - 1;
      await one.begin(seed, first);
    }
    if (this.phase === 'ended') this.phase = 'playing';
    this.pace.restart();
    await this.readAll();
    if (!this.many) this.show();
  }

  /**
   * One decision of every side. Those that have ended wait.
   * @param {boolean} [shown]
   */
  async step(shown = true) {
    for (const [i, one] of this.sides.entries()) {
      await one.advance();
      for (const event of this.scheduled(i, one.step)) await one.set(event);
    }
    this.pace.count();
    const {ended, step} = this.sides[0];
    if (!this.many && this.readEvery > 0 && step % this.readEvery === 0) await this.readAll();
    if (ended) await this.conclude();
    if (shown && !this.many) this.show();
  }

  async conclude() {
    const found = this.sides.map((one, i) => one.outcome(i === 0 ? 'first' : 'second'));
    this.outcomes = [...this.outcomes, ...found].slice(-MOST_OUTCOMES);
    this.many?.outcomes.push(...found);
    this.episodes = [...this.episodes, await savedEpisode(this.sides[0])].slice(-MOST_SAVED);
    this.endedAt = performance.now();
    if (!this.many) this.phase = 'ended';
  }

  /** One decision of the ended episode's replay with all cameras. Whether there was one. */
  async retrace() {
    if (!this.retraces.length) this.retraces = this.sides.map(one => new Retrace(one));
    const next = this.retraces.find(one => !one.done);
    if (!next) return false;
    await this.pace.yield();
    try {
      await next.advance();
    } catch (error) {
      next.leave();
      throw error;
    }
    if (this.retraces.every(one => one.done)) {
      this.endedAt = performance.now(); // The words are all there now, and take their time to read.
      this.show();
    }
    return true;
  }

  async playMany() {
    const many = this.many;
    if (!many) return;
    await this.pace.yield();
    await this.step();
    const now = performance.now();
    if (this.sides[0].ended) {
      many.done += 1;
      if (many.done >= many.of) return this.endMany();
      this.tellMany(false);
      await this.begin(this.nextSeed());
    }
    if (now - many.shown > RARELY) {
      many.shown = now;
      this.show();
    }
  }

  /** A run of many episodes is over, also before its last one: who shows it hears of that. */
  stopMany() {
    if (this.many) this.tellMany(true);
    this.many = null;
  }

  endMany() {
    this.stopMany();
    this.phase = this.sides[0].ended ? 'ended' : 'paused';
    this.show();
  }

  /** @param {boolean} ended */
  tellMany(ended) {
    const {done, of, outcomes} = /** @type {Many} */ (this.many);
    this.say({kind: 'Run', done, of, ended, outcomes: [...outcomes]});
  }

  /**
   * What the schedule does to a side at a step; cameras come back before others fail.
   * @param {number} index
   * @param {number} step
   */
  scheduled(index, step) {
    return this.schedule.filter(event => event.step === step && covers(event.side, index));
  }

  async readAll() {
    if (this.readEvery === 0) return;
    for (const one of this.sides) await one.readAll();
  }

  /**
   * @param {any} error
   * @param {boolean} [fatal]
   */
  problem(error, fatal = false) {
    const refused = fatal ? refusal(error) : '';
    const message = refused || String(error?.message ?? error);
    this.say({kind: 'Problem', message, fatal, refused: refused !== ''});
  }

  show() {
    if (this.sides.length === 0) return;
    const [first, second] = this.sides;
    this.number += 1;
    const phase = /** @type {any} */ (this.many ? 'running' : this.phase);
    /** @type {import('./messages.js').Frame} */
    const frame = {
      kind: 'Frame',
      number: this.number,
      phase,
      speed: this.pace.rate,
      rate: this.pace.achieved(),
      auto_next: this.autoNext,
      first: first.world(),
      second: second ? second.world() : null,
      outcomes: this.outcomes,
    };
    this.say(frame, buffersOf(frame));
  }
}
