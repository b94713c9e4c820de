/**
 * A late picture: the change of the picture is compared with earlier movements of the robot.
 *
 * The same as `madviz/guard/lag.py`: from a change of the cells, fitted weights read how the robot
 * moved. Where that agrees best with what the robot did some steps ago, the picture is late.
 */
import {CELLS} from './guard_pictures.js';

/** Lags of 0 to 10 steps are compared; 0 and 1 are on time. */
export const LAGS = 11;
const FADE = 0.95, FIRST = 10;
/** A late picture agrees at its lag by this, and more than a picture on time by `MARGIN`. */
const AGREEMENT = 0.7, MARGIN = 0.2;
/** Movements that differ by less, in units of the state, count as equal. */
const CLEAR = 0.2;
/** The agreement that shows that a picture is late no more. */
const ON_TIME = 0.5;
/** @type {number[]} Never changed. */
const NOTHING = Array(LAGS).fill(0);

export class LagTest {
  /** @param {import('./guard.js').StreamValues} values */
  constructor({numbers, scales, weights}) {
    this.numbers = numbers;
    this.scales = scales;
    /** (441 x J) */
    this.weights = Int8Array.from(atob(weights), letter => letter.charCodeAt(0));
    /** False where nothing can be read from this stream's pictures. */
    this.possible = numbers.length > 0;
    this.count = this.seen = 0;
    this.products = NOTHING;
    this.moved = NOTHING;
  }

  /** Forgets the past. */
  restart() {
    this.count = this.seen = 0;
    this.products = NOTHING;
    this.moved = NOTHING;
  }

  /** The robot's movement (J), as read from a change of the cells. @param {Float64Array} change */
  read(change) {
    const count = this.numbers.length, found = Array(count).fill(0);
    for (let cell = 0; cell < CELLS * CELLS; cell++) {
      if (change[cell] === 0) continue;
      for (let j = 0; j < count; j++) found[j] += change[cell] * this.weights[cell * count + j];
    }
    return found.map((value, j) => value * this.scales[j]);
  }

  /** The robot's movement (J) between two states. @param {number[]} now @param {number[]} before */
  between(now, before) {
    return this.numbers.map(number => now[number] - before[number]);
  }

  /** @param {Float64Array} change @param {number[][]} states (LAGS + 1), the newest first. */
  add(change, states) {
    const read = this.read(change);
    this.seen = FADE * this.seen + dot(read, read);
    const moves = this.products.map((_, lag) => this.between(states[lag], states[lag + 1]));
    this.products = this.products.map((old, lag) => FADE * old + dot(moves[lag], read));
    this.moved = this.moved.map((old, lag) => FADE * old + dot(moves[lag], moves[lag]));
    this.count += 1;
  }

  /** By lag, from -1 to 1. */
  agreements() {
    return this.products.map((product, lag) =>
      product / Math.sqrt(this.seen * this.moved[lag] + 1e-9));
  }

  /** By how many steps the picture is late; 0 where nothing says so. */
  lag() {
    if (!this.possible || this.count < FIRST) return 0;
    const found = this.agreements(), best = found.indexOf(Math.max(...found));
    const late = best >= 2 && found[best] >= AGREEMENT;
    return late && found[best] - Math.max(found[0], found[1]) >= MARGIN ? best : 0;
  }

  /** Whether the pictures of the last steps agree best with the newest movements. */
  onTime() {
    if (!this.possible || this.count < FIRST) return false;
    const found = this.agreements();
    return Math.max(found[0], found[1]) >= Math.max(ON_TIME, Math.max(...found.slice(2)) + 0.05);
  }

  /**
   * Whether the change shows all that the robot did in the last `behind` + 1 steps, or the first of
   * these steps alone; null where that cannot be decided.
   * @param {Float64Array} change
   * @param {number[][]} states
   * @param {number} behind
   * @param {boolean} [clearly] Asks for half the distance.
   * @returns {boolean | null}
   */
  caughtUp(change, states, behind, clearly = false) {
    if (!this.possible || behind + 1 >= states.length) return null;
    const all = this.between(states[0], states[behind + 1]);
    const first = this.between(states[behind], states[behind + 1]);
    if (Math.max(...all.map((value, j) => Math.abs(value - first[j]))) < CLEAR) return null;
    const read = this.read(change), share = clearly ? 0.25 : 1;
    const far = (/** @type {number[]} */ from) => dot(...minus(read, from));
    return far(all) < share * far(first);
  }
}

/** @param {number[]} one @param {number[]} other */
function dot(one, other) {
  return one.reduce((sum, value, i) => sum + value * other[i], 0);
}

/** The difference, twice. @param {number[]} one @param {number[]} other @returns {[number[], number[]]} */
function minus(one, other) {
  const difference = one.map((value, i) => value - other[i]);
  return [difference, difference];
}
