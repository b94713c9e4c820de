/** When the next decision is due, and how many there have been. */

/** Decisions over which the rate is measured. */
const COUNTED = 20;

export class Pace {
  constructor() {
    /** Decisions a second; null: as fast as it goes. @type {number | null} */
    this.rate = 10;
    this.next = 0;
    /** @type {number[]} */
    this.times = [];
    /** @type {() => void} */
    this.wake = () => {};
    this.channel = new MessageChannel();
  }

  /** Counts anew: an episode begins, or the page was hidden. */
  restart() {
    this.next = 0;
    this.times = [];
  }

  /** Waits a while at most; whether a decision is due then. */
  async due() {
    if (this.rate === null) {
      await this.yield();
      return true;
    }
    const left = this.next - performance.now();
    if (left > 0) {
      await this.sleep(left);
      return performance.now() >= this.next;
    }
    await this.yield();
    const now = performance.now();
    // Who is late does not hurry to make up for it.
    this.next = Math.max(this.next + 1000 / this.rate, now);
    return true;
  }

  /** A decision was taken. */
  count() {
    this.times = [...this.times, performance.now()].slice(-COUNTED);
  }

  /** Decisions a second; NaN until there are enough. */
  achieved() {
    const {times} = this;
    const count = times.length - 1;
    return count < 3 ? NaN : 1000 * count / (times[count] - times[0]);
  }

  /**
   * Until a command comes, or for some milliseconds.
   * @param {number} [most]
   * @returns {Promise<void>}
   */
  sleep(most) {
    return new Promise(resolve => {
      const timer = most === undefined ? 0 : setTimeout(resolve, most);
      this.wake = () => {
        clearTimeout(timer);
        this.wake = () => {};
        resolve();
      };
    });
  }

  /** Lets commands in; a timer would wait for 4 ms. @returns {Promise<void>} */
  yield() {
    return new Promise(resolve => {
      this.channel.port1.onmessage = () => resolve();
      this.channel.port2.postMessage(null);
    });
  }
}

/**
 * The memory of all arrays in an answer, which is handed over and not copied.
 * @param {any} value
 * @returns {ArrayBuffer[]}
 */
export function buffersOf(value) {
  if (ArrayBuffer.isView(value)) return [/** @type {ArrayBuffer} */ (value.buffer)];
  if (typeof value !== 'object' || value === null) return [];
  return [...new Set(Object.values(value).flatMap(buffersOf))];
}
