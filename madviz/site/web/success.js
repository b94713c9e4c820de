/**
 * Success by subset of cameras: counted in this browser, beside what was measured with madviz.
 *
 * A bar is a rate, the line over it its 95 % Wilson interval. An episode counts if nobody touched a
 * switch between its first and its last step.
 */

import {make, say, term} from './dom.js';
import {listed} from './ending.js';
import {rateWords, wilson} from './statistics.js';
import {conditionWords} from './words.js';

/** @typedef {import('./messages.js').Condition} Condition */
/** @typedef {import('./messages.js').Rate} Rate */
/** @typedef {import('./messages.js').World} World */
/** @typedef {import('./catalogue.js').Entry} Entry */

export class Success {
  /**
   * @param {Entry} entry
   * @param {import('./statistics.js').Tally} tally
   */
  constructor(entry, tally) {
    this.entry = entry;
    this.tally = tally;
    this.body = make('tbody');
    this.note = make('p', {class: 'soft'});
    const columns = ['the policy gets', 'measured', ...(entry.recorded ? [] : ['counted here'])];
    this.element = make('section', {class: 'panel'}, make('h3', {}, term('success', 'Success')),
      make('p', {}, needsWords(entry)),
      make('div', {class: 'scroll'}, make('table', {class: 'success'},
        make('thead', {}, make('tr', {}, ...columns.map(words =>
          make('th', {scope: 'col'}, term(words))))), this.body)),
      this.note);
    say(this.note, `Goal: ${entry.success}. It counts at the last step. Brackets: 95 % interval. `
      + `Measured on ${entry.seeds_words || 'no seeds yet'}. † not trained on.`);
    this.shown = '';
  }

  /** @param {World} world */
  draw(world) {
    const conditions = this.rows(world.condition);
    const counts = conditions.map(one => this.tally.count(this.entry.name, one));
    const state = JSON.stringify([world.condition, conditions, counts]);
    if (state === this.shown) return;
    this.shown = state;
    this.body.replaceChildren(...conditions.map((condition, i) => {
      const {successes, n} = counts[i], current = same(condition, world.condition);
      const {occlusions, guarded} = condition;
      const measured = occlusions || guarded ? undefined : this.entry.measured[condition.subset];
      const here = n === 0 ? '' : bar(successes / n, wilson(successes, n), n);
      const trained = this.entry.trained_subsets.includes(condition.subset);
      return make('tr', {class: current ? 'current' : '', 'aria-current': current && 'true'},
        make('th', {scope: 'row'},
          conditionWords(condition, this.entry.cameras) + (trained ? '' : ' †')),
        make('td', {}, measured ? bar(measured.success, measured.ci95, measured.n) : ''),
        ...(this.entry.recorded ? [] : [make('td', {}, here)]));
    }));
  }

  /** What was measured, what was counted, and what is on now. @param {Condition} now */
  rows(now) {
    /** @type {Condition[]} */
    const rows = Object.keys(this.entry.measured).map(subset => ({subset, occlusions: ''}));
    for (const one of [...this.tally.conditions(this.entry.name), now]) {
      if (!rows.some(row => same(row, one))) rows.push(one);
    }
    return rows;
  }
}

/**
 * Which cameras a policy needs, from what was measured without each: `Merged Only needs First person:
 * without it, 0.00 [0.00, 0.04] n=100.` A camera is needed where the interval lies below half of the
 * success with all, whatever that is within its own interval; '' where that is not decided.
 * @param {Pick<Entry, 'label' | 'cameras' | 'measured'>} entry
 */
export function needsWords({label, cameras, measured}) {
  const {all} = measured;
  const without = cameras.flatMap(({name, label: camera}) => {
    const rate = measured[cameras.filter(one => one.name !== name).map(one => one.name).join('+')];
    return rate ? [{camera, rate, words: rateWords(rate.success, rate.ci95, rate.n)}] : [];
  });
  if (!all || cameras.length < 3 || without.length < cameras.length) return '';
  const [low, high] = all.ci95.map(end => end / 2);
  const needed = without.filter(({rate}) => rate.ci95[1] < low);
  if (needed.length) {
    return `${label} needs ${listed(needed.map(({camera}) => camera))}: without it, ${
      listed(needed.map(({words}) => words))}.`;
  }
  if (without.some(({rate}) => rate.ci95[0] <= high)) return '';
  const worst = without.reduce((one, other) => other.rate.success < one.rate.success ? other : one);
  return `${label} needs no single camera: without any one, at least ${worst.words}.`;
}

/** @param {Condition} one @param {Condition} other */
function same(one, other) {
  return one.subset === other.subset && one.occlusions === other.occlusions
    && Boolean(one.guarded) === Boolean(other.guarded);
}

/** @param {number} rate @param {[number, number]} interval @param {number} n */
function bar(rate, interval, n) {
  const [value, ...rest] = rateWords(rate, interval, n).split(' ');
  const track = make('span', {class: 'track', 'aria-hidden': 'true'},
    make('i', {class: 'fill'}), make('i', {class: 'span'}));
  track.style.setProperty('--rate', `${100 * rate}%`);
  track.style.setProperty('--low', `${100 * interval[0]}%`);
  track.style.setProperty('--wide', `${100 * (interval[1] - interval[0])}%`);
  return make('span', {class: 'bar'}, track, make('span', {class: 'num'}, `${value} `,
    make('small', {}, rest.join(' '))));
}

/** The button that plays many episodes, and how far it is. */
export class RunMany {
  /**
   * @param {number} episodes
   * @param {(command: import('./messages.js').Command) => void} send
   */
  constructor(episodes, send) {
    this.running = false;
    this.button = make('button', {type: 'button', onclick: () =>
      send(this.running ? {kind: 'StopRun'} : {kind: 'RunMany', episodes})});
    this.words = make('span', {class: 'soft', role: 'status'});
    this.element = make('div', {class: 'many'}, this.button, this.words);
    this.episodes = episodes;
    this.label();
  }

  /** Another engine plays now, in which nothing runs. */
  reset() {
    this.running = false;
    this.label();
    say(this.words, '');
  }

  label() {
    say(this.button, this.running ? 'Stop' : `Run ${this.episodes}`);
  }

  /** @param {import('./messages.js').Run} run */
  update(run) {
    this.running = !run.ended;
    this.label();
    const sides = ['first', 'second'].map(side => run.outcomes.filter(one => one.side === side))
      .filter(side => side.length);
    const counts = sides.map((side, i) => `${sides.length > 1 ? `${'AB'[i]} ` : ''}${
      side.filter(one => one.success).length} of ${side.length}`);
    say(this.words, `${run.done} of ${run.of} episodes${run.ended ? '' : ' …'}, `
      + `${counts.join(', ') || '0 of 0'} successful`);
  }
}
