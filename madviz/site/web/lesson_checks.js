/**
 * Lesson 0's two exercises: what an answer lacks, in words; '' where it is right.
 *
 * `madviz/teaching/checks/lesson_00.py` asks the same of a notebook. Hints go from a question to
 * nearly a plan, and none is the answer.
 */

import {parseLink} from './link.js';

/** @typedef {Record<string, import('./messages.js').Rate>} Measured Success by subset. */

export const MAD = 'metaworld-hammer-mad-light';
export const MERGED_ONLY = 'metaworld-hammer-merged-only-light';
export const WITHOUT_FIRST = 'third_a+third_b', ALONE = 'first';

export const HINTS = {
  rates: [
    'Which two cameras are left when First person is off?',
    'In the table Success, look for the row that names these two, in the column measured.',
    'Both sides have such a table. A rate is a number from 0 to 1, with two digits.',
  ],
  link: [
    'Which part of the address names the policy, and which one a camera?',
    'A camera is written as camera=what@step, and parts are joined with &.',
    'The name of the camera is third_a, and what it does is one of off, black, noise, freeze.',
  ],
};

/**
 * @param {string} mad What was typed for MAD. @param {string} merged For Merged Only.
 * @param {Record<string, Measured>} measured By policy.
 */
export function ratesLack(mad, merged, measured) {
  if (!mad.trim() || !merged.trim()) return 'Nothing is answered yet: two rates.';
  const typed = [Number(mad.replace(',', '.')), Number(merged.replace(',', '.'))];
  if (typed.some(value => !(value >= 0 && value <= 1))) return 'Expected two numbers from 0 to 1.';
  const [one, two] = [MAD, MERGED_ONLY].map(name => measured[name]);
  const right = [one[WITHOUT_FIRST].success, two[WITHOUT_FIRST].success];
  if (near(typed, right)) return '';
  if (near(typed, [right[1], right[0]])) return 'The two have changed places.';
  if (near(typed, [one[ALONE].success, two[ALONE].success])) {
    return 'These are the rates with First person alone, not without it.';
  }
  return 'These are not the rates without First person.';
}

/** @param {number[]} found @param {number[]} expected */
function near(found, expected) {
  return found.every((value, i) => Math.abs(value - expected[i]) < 0.005);
}

/** @param {string} text A link, or its part from # on. */
export function linkLacks(text) {
  if (!text.trim()) return 'Nothing is answered yet: a link.';
  const hash = text.trim().replace(/^[^#]*#/, '');
  const {state, problems} = parseLink(hash);
  if (problems.length) return problems[0];
  if (state.policy !== MERGED_ONLY) return 'The policy of this link is not Merged Only.';
  const [event, ...more] = state.events.filter(one => one.guard === undefined);
  if (!event || !event.state) return 'No camera is switched in this link.';
  if (more.length) return 'More than one thing happens in this link.';
  if (event.side === 'second') return 'This happens on side B, which is another policy.';
  if (event.camera !== 'third_a') return 'This is another camera than Third A.';
  if (event.state.input === 'off') return 'Off leaves the sum; black stays in it.';
  if (event.state.input === 'depth') return 'These policies get no depth.';
  if (event.state.occlusion.kind !== 'black') return 'Third A sends something else than black.';
  return event.step === 20 ? '' : `Third A turns black at step ${event.step}.`;
}
