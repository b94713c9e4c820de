/**
 * The words that end an episode in which a camera was changed, and every comparison.
 *
 *     First person was dropped at step 15. MAD drove the nail in, Merged Only did not. MAD's hand was
 *     up to 0.6 cm from its path with all cameras; Merged Only's up to 12.3 cm, and 1 cm for the first
 *     time at step 23. Without it from the start, over 100 episodes: MAD 1.00 [0.96, 1.00] and
 *     Merged Only 0.00 [0.00, 0.04].
 *
 * The same as `madviz/session/ending.py`; one table of cases tests both.
 */

import {wilson} from './statistics.js';
import {labelOf, moveWords} from './words.js';

/** @typedef {import('./messages.js').World} World */
/** @typedef {import('./messages.js').CameraState} CameraState */
/** @typedef {{value: number, interval: [number, number], n: number}} Rate */
/** @typedef {[label: string, past: string, step: number | null]} Deed What befell a camera: null
 *   where not until the end. */
/** @typedef {{label: string, success: boolean, rate: Rate, deeds: Deed[],
 *   departure?: [number, number | null] | null}} EndedSide */

/** Metres between two paths from which on they are said to differ. */
const APART = 0.01;

/**
 * What befell the cameras of an episode, as its decisions saw it.
 * @param {World} world
 * @param {import('./messages.js').CameraSpec[]} cameras
 * @returns {Deed[]}
 */
export function deedsOf(world, cameras) {
  /** @type {Deed[]} */
  const deeds = [];
  for (const {name} of cameras) {
    const events = world.events.filter(one => one.camera === name && one.step < world.horizon);
    const label = labelOf(name, cameras);
    /** @type {CameraState | undefined} */
    let state;
    /** @type {import('./messages.js').Displacement | null} */
    let move = null;
    let past = '', since = 0, worst = '';
    events.forEach((event, i) => {
      if (event.state) state = event.state; else move = event.move ?? null;
      if (events[i + 1]?.step === event.step) return; // No decision was taken so.
      const now = wayOf(state, move);
      const words = now && pastOf(now, state, move);
      if (words !== past) since = event.step;
      past = words;
      const rank = ['', 'moved', 'occluded', 'off'];
      const bad = ['', 'moved', 'off'].includes(now) ? now : 'occluded';
      if (rank.indexOf(bad) > rank.indexOf(worst)) worst = bad;
    });
    if (past) deeds.push([label, past, since]);
    else if (worst) deeds.push([label, pastOf(worst, undefined, null), null]);
  }
  return deeds;
}

/** @param {CameraState | undefined} state @param {unknown} move */
function wayOf(state, move) {
  if (state?.input === 'off') return 'off';
  if (state && state.occlusion.kind !== 'none') return state.occlusion.kind;
  return move ? 'moved' : '';
}

/**
 * @param {string} way
 * @param {CameraState | undefined} state
 * @param {import('./messages.js').Displacement | null} move
 */
function pastOf(way, state, move) {
  const share = `${Math.round(100 * (state?.occlusion.strength ?? 1))} %`;
  return {off: 'was dropped', occluded: 'was broken', black: 'sent black',
    noise: `sent ${share} noise`, freeze: 'was frozen', blur: `was blurred by ${share}`,
    patch: 'had a patch in view',
    moved: move ? `stood elsewhere (${moveWords(move)})` : 'stood elsewhere'}[way] ?? way;
}

/**
 * The words for the present frame; null where no episode has ended, or nothing was done in it.
 * @param {World[]} worlds
 * @param {import('./catalogue.js').Entry[]} entries
 * @param {import('./statistics.js').Tally} tally Of what was counted here.
 */
export function endingOf(worlds, entries, tally) {
  if (worlds.some(world => !world.ended)) return null;
  const labels = sideLabels(entries);
  const sides = worlds.map((world, i) => ({label: labels[i],
    success: world.success, rate: rateOf(world, entries[i], tally),
    deeds: deedsOf(world, entries[i].cameras), departure: departureOf(world.paths)}));
  if (sides.length === 1 && !sides[0].deeds.length) return null;
  const parts = endingParts(sides, entries[0].done);
  if (entries[0].recorded && sides.some(side => side.deeds.some(([, , step]) => step !== 0))) {
    parts.result += ' (This was recorded with the cameras as at the end, from the start.)';
  }
  return parts;
}

/**
 * The largest distance of the hand from its path with all cameras, metres, and the first step at which
 * it is `APART`.
 * @param {import('./messages.js').HandPaths | null} [paths]
 * @returns {[number, number | null] | null}
 */
export function departureOf(paths) {
  if (!paths) return null;
  const {since, taken, intact} = paths;
  const apart = Array.from({length: taken.length / 3}, (_, step) => Math.hypot(
    ...[0, 1, 2].map(axis => taken[3 * step + axis] - intact[3 * step + axis])));
  const first = apart.findIndex(metres => metres >= APART);
  return [Math.max(...apart), first < 0 ? null : since + first];
}

/**
 * What is known of the condition of the last decision: what was measured before, or counted here.
 * @param {World} world
 * @param {import('./catalogue.js').Entry} entry
 * @param {import('./statistics.js').Tally} tally
 * @returns {Rate}
 */
function rateOf({policy, condition: now, decided: condition = now}, entry, tally) {
  const {successes, n} = tally.count(policy, condition);
  const known = condition.occlusions ? undefined : entry.measured[condition.subset];
  if (known && known.n > n) return {value: known.success, interval: known.ci95, n: known.n};
  return {value: n ? successes / n : NaN, interval: wilson(successes, n), n};
}

/**
 * The four parts of the words; each may be empty.
 * @param {EndedSide[]} sides One or two.
 * @param {[string, string]} done What was done, after *did not* and in the past.
 */
export function endingParts(sides, done) {
  return {done: whatWasDone(sides), result: whoSucceeded(sides, done),
    cameOfIt: whatCameOfIt(sides), measured: whatWasMeasured(sides),
    winners: sides.filter(side => side.success).map(side => side.label)};
}

export const BOTH = 'both';
const NEITHER = 'neither';
const YES_OR_NO = ['yes', 'no'];

/**
 * The answers to the question who will succeed.
 * @param {import('./catalogue.js').Entry[]} entries
 */
export function answersFor(entries) {
  return entries.length > 1 ? [...sideLabels(entries), BOTH, NEITHER] : YES_OR_NO;
}

/** @param {import('./catalogue.js').Entry[]} entries */
function sideLabels(entries) {
  const same = entries.length > 1 && entries[0].label === entries[1].label;
  return entries.map((entry, i) => same ? 'AB'[i] : entry.label);
}

/**
 * `You said both, and it was MAD alone.` A guess is one of `answersFor`.
 * @param {string} guess
 * @param {string[]} winners
 */
export function guessWords(guess, winners) {
  if (YES_OR_NO.includes(guess)) {
    const right = (guess === 'yes') === winners.length > 0;
    return `You said ${guess}, ${right ? 'and so it was'
      : `but it ${winners.length ? 'did' : 'did not'}`}.`;
  }
  const came = [NEITHER, `${winners[0]} alone`, BOTH][winners.length];
  const right = guess === [NEITHER, winners[0], BOTH][winners.length];
  return `You said ${guess}, and ${right ? 'so it was' : `it was ${came}`}.`;
}

/** @param {EndedSide[]} sides */
function whatWasDone(sides) {
  if (alike(sides)) return sides[0].deeds.length ? `${deedWords(sides[0].deeds)}.` : '';
  return `${sides.map(({label, deeds}) =>
    `${label}: ${deedWords(deeds) || 'all cameras intact'}`).join('; ')}.`;
}

/** @param {EndedSide[]} sides */
function alike(sides) {
  return sides.every(side => JSON.stringify(side.deeds) === JSON.stringify(sides[0].deeds));
}

/** @param {Deed[]} deeds */
function deedWords(deeds) {
  return listed(deeds.map(([label, past, step]) => {
    const place = past === 'was dropped' ? 'at' : 'from';
    const when = step === null ? 'for a while' : step === 0 ? 'from the start'
      : `${place} step ${step}`;
    return `${label} ${past} ${when}`;
  }));
}

/** `a`, `a and b`, `a, b and c`. @param {string[]} parts */
export function listed(parts) {
  const last = parts.slice(-1);
  return [...(parts.length > 1 ? [parts.slice(0, -1).join(', ')] : []), ...last].join(' and ');
}

/** @param {EndedSide[]} sides @param {[string, string]} done */
function whoSucceeded(sides, [base, past]) {
  const [first, second] = sides;
  if (!second) return first.success ? `${first.label} ${past}.` : `${first.label} did not ${base}.`;
  if (first.success && second.success) return `${first.label} and ${second.label} both ${past}.`;
  if (!first.success && !second.success) return `Neither ${first.label} nor ${second.label} ${past}.`;
  const [winner, loser] = first.success ? [first, second] : [second, first];
  return `${winner.label} ${past}, ${loser.label} did not.`;
}

/** @param {EndedSide[]} sides */
function whatCameOfIt(sides) {
  const parts = sides.flatMap(({label, departure}) => departure ? [{label, departure}] : [])
    .map(({label, departure: [largest, step]}, i) => `${label}${i ? "'s" : "'s hand was"} ${
      largest < 0.001 ? 'less than 0.1' : `up to ${(100 * largest).toFixed(1)}`
    } cm${i ? '' : ' from its path with all cameras'}${
      step === null ? '' : `, and 1 cm for the first time at step ${step}`}`);
  return parts.length ? `${parts.join('; ')}.` : '';
}

/** @param {EndedSide[]} sides */
function whatWasMeasured(sides) {
  const rates = sides.map(side => side.rate), counts = new Set(rates.map(rate => rate.n));
  if (rates.every(rate => !rate.n)) return 'How often that happens is not measured yet.';
  const lead = measuredUnder(sides);
  if (counts.size === 1) {
    return `${lead ? `${lead}, over` : 'Over'} ${rates[0].n} episodes: ${
      listed(named(sides, rates.map(inWords)))}.`;
  }
  return `${lead || 'Measured'}: ${listed(named(sides, rates.map(rate =>
    rate.n ? `${inWords(rate)} (n = ${rate.n})` : 'not measured')))}.`;
}

/** `MAD 1.00 [0.96, 1.00]` for each of two sides; one needs no name.
 * @param {EndedSide[]} sides @param {string[]} said */
function named(sides, said) {
  return sides.length === 1 ? said : said.map((words, i) => `${sides[i].label} ${words}`);
}

/** The condition that was measured, where it did not hold all the time. @param {EndedSide[]} sides */
function measuredUnder(sides) {
  const [deed, ...more] = sides[0].deeds;
  if (sides.every(side => side.deeds.every(([, , step]) => step === 0))) return '';
  if (alike(sides) && !more.length && deed[1] === 'was dropped' && deed[2] !== null) {
    return 'Without it from the start';
  }
  return 'With the cameras as at the end, from the start';
}

/** @param {Rate} rate */
function inWords({value, interval: [low, high]}) {
  return `${value.toFixed(2)} [${low.toFixed(2)}, ${high.toFixed(2)}]`;
}
