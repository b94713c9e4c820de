/**
 * What a count of successes says: Wilson's interval, and rates by policy and condition.
 *
 * The same formula as `madviz/measure/statistics.py`. 18 of 20 is 0.90 [0.70, 0.97]: twenty
 * episodes leave a wide interval, and the page never shows a rate without it.
 */

const Z = 1.959963984540054; // Of the normal distribution, 95 %, two-sided.

/**
 * @param {number} successes
 * @param {number} n
 * @returns {[number, number]} The 95 % interval of a success rate; [0, 1] where nothing was tried.
 */
export function wilson(successes, n) {
  if (!(n > 0)) return [0, 1];
  const rate = successes / n, shrink = 1 / (1 + Z * Z / n);
  const centre = shrink * (rate + Z * Z / (2 * n));
  const half = shrink * Z * Math.sqrt(rate * (1 - rate) / n + Z * Z / (4 * n * n));
  // At 0 of n and n of n the bound is exact; rounding must not push it off.
  return [
    successes === 0 ? 0 : Math.max(centre - half, 0),
    successes === n ? 1 : Math.min(centre + half, 1),
  ];
}

/**
 * @param {number} rate
 * @param {[number, number]} interval
 * @param {number} n
 * @returns {string} `0.90 [0.70, 0.97] n=20`.
 */
export function rateWords(rate, interval, n) {
  const [low, high] = interval.map(value => value.toFixed(2));
  return `${rate.toFixed(2)} [${low}, ${high}] n=${n}`;
}

/** @typedef {{successes: number, n: number}} Count */

/**
 * Counts episodes by policy and condition. An episode counts once, also where it was played again:
 * the same seed under the same switches says nothing new.
 */
export class Tally {
  constructor() {
    /** @type {Map<string, Map<number, boolean>>} */
    this.outcomes = new Map();
  }

  /**
   * @param {import('./messages.js').Outcome} outcome
   * @returns {boolean} Whether it was new.
   */
  add(outcome) {
    if (!outcome.condition) return false; // Somebody changed the switches in mid-episode.
    const key = tallyKey(outcome.policy, outcome.condition);
    const seeds = this.outcomes.get(key) ?? new Map();
    const known = seeds.has(outcome.seed);
    seeds.set(outcome.seed, outcome.success);
    this.outcomes.set(key, seeds);
    return !known;
  }

  /**
   * @param {string} policy
   * @param {import('./messages.js').Condition} condition
   * @returns {Count}
   */
  count(policy, condition) {
    const seeds = this.outcomes.get(tallyKey(policy, condition));
    if (!seeds) return {successes: 0, n: 0};
    return {successes: [...seeds.values()].filter(Boolean).length, n: seeds.size};
  }

  /**
   * @param {string} policy
   * @returns {import('./messages.js').Condition[]} The conditions that were counted for a policy.
   */
  conditions(policy) {
    return [...this.outcomes.keys()]
      .filter(key => key.startsWith(`${policy} `))
      .map(key => key.slice(policy.length + 1).split(' '))
      .map(([subset, occlusions, guarded]) => ({subset, occlusions, guarded: Boolean(guarded)}));
  }
}

/**
 * @param {string} policy
 * @param {import('./messages.js').Condition} condition
 */
function tallyKey(policy, condition) {
  return `${policy} ${condition.subset} ${condition.occlusions}${condition.guarded ? ' guarded' : ''}`;
}
