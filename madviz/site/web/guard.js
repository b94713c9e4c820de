/**
 * Says for each stream of pictures whether its camera works, one step at a time.
 *
 * The same as `madviz/guard/detector.py`, which says why; one table of cases tests both. Pictures
 * and state go in, verdicts come out. What a verdict needs of the past is kept here.
 */
import {LAGS, LagTest} from './guard_lag.js';
import {CELLS, sumsOf} from './guard_pictures.js';

/** @typedef {import('./messages.js').Picture} Picture */
/** @typedef {import('./guard_pictures.js').Sums} Sums */
/** @typedef {'fine' | 'gone' | 'black' | 'covered' | 'noise' | 'blurred' | 'frozen' | 'lossy' | 'late'} Kind */
/** `since`: the step at which it was noticed.
 * @typedef {{kind: Kind, since: number | null, why: string}} Verdict */
/**
 * How the pictures of one stream usually are, as in guard.json.
 * @typedef {{spread: number, dark: number, rough: number, edges: number, reach: number[],
 *   numbers: number[], scales: number[], weights: string}} StreamValues
 */
/**
 * The whole file.
 * @typedef {{state: number[], unit: number[], streams: Record<string, StreamValues>}} GuardValues
 */

/** Steps in a row before a camera is left out; 1 for other kinds.
 * @type {Partial<Record<Kind, number>>} */
const CONFIRM = {covered: 2, blurred: 2};
/** Steps in a row in which lags must say that a picture is late. */
const LATE = 3;
/** Kinds that only new pictures end. @type {Kind[]} */
const STALE = ['frozen', 'lossy', 'late'];
/** Movements up to this are none, in units of the state. */
const SMALLEST = 0.01;
/** Good pictures in a row before a camera is used again. */
const GOOD = 3;
/** Steps within which a second freeze makes a camera lossy. */
const LOSSY = 20;
/** @type {[Kind, string]} */
const FINE = ['fine', ''];
/** @type {Verdict} */
const INTACT = {kind: 'fine', since: null, why: ''};
/**
 * What a stream remembers of its pictures.
 * @typedef {object} Memory
 * @property {Sums[]} past The pictures that came, the newest first.
 * @property {number[]} anchor Where the robot was when the picture last changed.
 * @property {number} repeats Steps since the picture last changed.
 * @property {boolean} stopped Whether it has not changed since a freeze was noticed.
 * @property {number[]} stops The steps at which the last two freezes were noticed.
 * @property {number} behind Steps by which the pictures are known to be late.
 * @property {number} lags Steps in a row in which lags say that the picture is late.
 */
/** @returns {Memory} */
const nothing = () => ({past: [], anchor: [], repeats: 0, stopped: false, stops: [], behind: 0, lags: 0});

export class Guard {
  /** @param {GuardValues} values */
  constructor(values) {
    this.values = values;
    this.now = 0;
    /** The robot's last places, the newest first. @type {number[][]} */
    this.states = [];
    this.watched = new Map(Object.entries(values.streams).map(([name, usual]) =>
      [name, new Stream(usual)]));
  }

  /** A guard that goes on from here by itself. @returns {Guard} */
  copy() {
    const watched = new Map([...this.watched].map(([name, stream]) => [name, stream.copy()]));
    return Object.assign(Object.create(Guard.prototype), this, {watched});
  }

  /**
   * @param {Record<string, Picture | null>} pictures By stream; null: no picture came. A stream
   *   that is not named is not watched at this step, and its past is forgotten.
   * @param {ArrayLike<number>} state (S) The robot's now.
   * @returns {Record<string, Verdict>}
   */
  step(pictures, state) {
    const {state: places, unit} = this.values;
    const here = places.map((place, i) => state[place] / unit[i]);
    const before = this.states.length ? this.states : Array(LAGS).fill(here);
    this.states = [here, ...before].slice(0, LAGS + 1);
    for (const [name, stream] of this.watched) {
      if (name in pictures) stream.take(pictures[name], this.states, this.now);
      else this.watched.set(name, new Stream(stream.values));
    }
    this.now += 1;
    return Object.fromEntries(Object.keys(pictures).map(name =>
      [name, /** @type {Stream} */ (this.watched.get(name)).verdict]));
  }
}

/** One stream: what its last pictures were, and the verdict on it. */
class Stream {
  /** @param {StreamValues} values */
  constructor(values) {
    this.values = values;
    this.reach = values.reach.map(size => Math.max(2 * size, SMALLEST));
    this.lag = new LagTest(values);
    this.verdict = INTACT;
    /** @type {Kind} */
    this.suspect = 'fine';
    this.suspected = this.good = 0;
    this.memory = nothing();
  }

  /** Forgets the pictures: the next one is not compared with any. One that was lost does not show
   * that a late camera is on time, unless nothing ever could. */
  forget() {
    this.lag.restart();
    this.memory = {...nothing(), behind: this.values.numbers.length ? this.memory.behind : 0};
  }

  /** @returns {Stream} */
  copy() { // Arrays are replaced, never changed.
    const lag = Object.assign(Object.create(LagTest.prototype), this.lag);
    return Object.assign(Object.create(Stream.prototype), this, {lag, memory: {...this.memory}});
  }

  /** @param {Picture | null} picture @param {number[][]} states @param {number} now */
  take(picture, states, now) {
    const [kind, why] = this.judge(picture, states, now);
    if (this.verdict.kind === 'fine') {
      this.suspected = kind === this.suspect ? this.suspected + 1 : 1;
      this.suspect = kind;
      if (kind !== 'fine' && this.suspected >= (CONFIRM[kind] ?? 1)) {
        this.verdict = {kind, since: now, why};
        this.good = 0;
      }
      return;
    }
    // A repeated picture does not show that a camera runs again.
    const stands = this.memory.repeats > 0 && STALE.includes(this.verdict.kind);
    this.good = kind === 'fine' && !stands ? this.good + 1 : 0;
    if (this.good === GOOD) this.verdict = INTACT;
    else if (kind !== 'fine' && kind !== this.verdict.kind) this.verdict = {...this.verdict, kind, why};
  }

  /** The kind that this step suggests, and why. @param {Picture | null} picture
   * @param {number[][]} states @param {number} now @returns {[Kind, string]} */
  judge(picture, states, now) {
    const sums = picture && sumsOf(picture);
    const found = sums && this.byItself(sums);
    if (sums && found === FINE) return this.inTime(sums, states, now);
    this.forget();
    return found ?? ['gone', 'no picture came'];
  }

  /** The kinds that one picture shows. @param {Sums} sums @returns {[Kind, string]} */
  byItself({spread, dark, rough, edges}) {
    const usual = this.values;
    if (spread < 0.25 * usual.spread) {
      return ['black', `an even picture: cells differ by ${spread.toFixed(0)}`];
    }
    if (dark >= usual.dark + 20) return ['covered', `${dark} of ${CELLS * CELLS} cells are black`];
    if (rough > 1.5 * usual.rough) {
      return ['noise', `roughness ${rough}; ${usual.rough} or less is usual`];
    }
    if (edges < 0.4 * usual.edges) return ['blurred', `${edges} edges; ${usual.edges} or more are usual`];
    return FINE;
  }

  /** The kinds that only a comparison with the past shows. @param {Sums} sums
   * @param {number[][]} states @param {number} now @returns {[Kind, string]} */
  inTime(sums, states, now) {
    const {memory} = this, [before] = memory.past, replayed = this.replayed(sums, states);
    memory.past = [sums, ...memory.past].slice(0, LAGS);
    if (!before) {
      memory.anchor = states[0];
      return FINE;
    }
    const change = sums.cells.map((cell, i) => cell - before.cells[i]);
    if (!change.some(Boolean)) return this.repeated(states, now);
    const stood = memory.repeats;
    memory.repeats = 0;
    memory.stopped = false;
    memory.anchor = states[0];
    if (replayed) this.isBehind(replayed);
    else if (stood) {
      const behind = memory.behind + stood, caughtUp = this.lag.caughtUp(change, states, behind);
      if (caughtUp !== null) this.isBehind(caughtUp ? 0 : behind);
    } else if (memory.behind && this.lag.caughtUp(change, states, memory.behind, true)) {
      this.isBehind(0);
    } else this.compareLags(change, states);
    return memory.behind ? ['late', `the picture shows what was ${memory.behind} steps ago`] : FINE;
  }

  /** Lateness that no repeated picture has shown, and its end.
   * @param {Float64Array} change @param {number[][]} states */
  compareLags(change, states) {
    const {memory} = this;
    this.lag.add(change, states);
    if (memory.behind) {
      if (this.lag.onTime()) this.isBehind(0);
      return;
    }
    const lag = this.lag.lag();
    memory.lags = lag ? memory.lags + 1 : 0;
    if (memory.lags === LATE) this.isBehind(lag);
  }

  /** @param {number} steps */
  isBehind(steps) {
    const {memory} = this;
    memory.behind = steps;
    memory.lags = 0;
    this.lag.restart();
  }

  /** The picture is the last one again: a fault only where the robot moved.
   * @param {number[][]} states @param {number} now @returns {[Kind, string]} */
  repeated(states, now) {
    const {memory} = this;
    memory.repeats += 1;
    if (!this.moved(states[0], memory.anchor)) {
      return memory.behind ? ['late', 'it was late, and the robot stands'] : FINE;
    }
    if (!memory.stopped) memory.stops = [...memory.stops, now].slice(-2);
    memory.stopped = true;
    const lossy = memory.stops.length === 2 && memory.stops[1] - memory.stops[0] <= LOSSY;
    return [lossy ? 'lossy' : 'frozen',
      `the robot moved, and the picture is the same for ${memory.repeats} steps`];
  }

  /** How many steps ago this picture came before, where the robot was elsewhere then; 0 if it is
   * new or the last one again. @param {Sums} sums @param {number[][]} states */
  replayed(sums, states) {
    const same = this.memory.past.findIndex(({spread, cells}) =>
      spread === sums.spread && cells.every((cell, i) => cell === sums.cells[i]));
    const moved = same > 0 && this.moved(states[0], states[same + 1]);
    return moved ? same + 1 : 0;
  }

  /** Whether a working camera would show that the robot is elsewhere.
   * @param {number[]} here @param {number[]} there */
  moved(here, there) {
    return this.reach.some((most, i) => Math.abs(here[i] - there[i]) > most);
  }
}
