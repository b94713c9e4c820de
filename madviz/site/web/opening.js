/**
 * The first scene: two policies, the same start, and one camera that goes off in both.
 *
 * What is said is read from frames as they come: by how much the action changed, how it ended, and
 * what was measured over many episodes. Nothing here knows in advance who succeeds.
 */

import {noOcclusion} from './camera_state.js';
import {make, say} from './dom.js';
import {endingOf, guessWords} from './ending.js';
import {effectWords, labelOf} from './words.js';

/** @typedef {import('./messages.js').Frame} Frame */

/** @typedef {import('./catalogue.js').Opening} Opening */

export const SPEED = 10;

/**
 * @param {Opening} opening
 * @returns {import('./messages.js').ScheduledEvent[]}
 */
export function openingEvents({camera, step}) {
  return [{step, side: 'both', camera, state: {input: 'off', occlusion: noOcclusion()}}];
}

/** @param {Opening} opening */
export function headline({entries}) {
  return entries.length > 1 ? 'Two policies, the same start, and one camera goes off'
    : 'One robot, several cameras, and one of them goes off';
}

/**
 * The line under the headline.
 * @param {Frame} frame
 * @param {Opening} opening
 * @param {import('./statistics.js').Tally} tally
 * @param {{asks: boolean, guess: string}} visitor
 * @returns {Node[]}
 */
export function story(frame, {entries, step, camera: name}, tally, {asks, guess}) {
  const worlds = [frame.first, ...(frame.second ? [frame.second] : [])];
  const camera = labelOf(name, entries[0].cameras);
  if (frame.first.ended) return endingNodes(endingOf(worlds, entries, tally), guess);
  if (asks && frame.first.step === 0) {
    return [strong(`${entries[0].task_label}. `), text(`At step ${step}, ${camera} goes off on both sides. `
      + 'Which policy will still do it?')];
  }
  if (frame.first.step < step) {
    return [strong(`${entries[0].task_label}. `),
      text(`${entries.length > 1 ? 'Both policies see the same' : 'The policy sees'} `
      + `${entries[0].cameras.length} cameras. At step ${step}, ${camera} goes off.`)];
  }
  const effects = worlds.map((world, i) => world.change
    ? `${entries[i].label}: ${effectWords(world.change)}` : '').filter(Boolean);
  return [strong(`Step ${step}: ${camera} is off. `),
    text(effects.length ? `${effects.join('. ')}.` : '')];
}

/** @param {ReturnType<typeof endingOf>} parts @param {string} [guess] @returns {Node[]} */
export function endingNodes(parts, guess = '') {
  return parts ? [text(parts.done ? `${parts.done} ` : ''), strong(parts.result),
    text(guess ? ` ${guessWords(guess, parts.winners)}` : ''), text(` ${parts.measured}`)] : [];
}

/** @param {string} words */
function text(words) {
  return document.createTextNode(words);
}

/** @param {string} words @param {string} [kind] */
function strong(words, kind) {
  return make('b', kind ? {class: kind} : {}, words);
}

/**
 * Replaces the line where it says something new.
 * @param {HTMLElement} line
 * @param {Node[]} nodes
 */
export function tell(line, nodes) {
  const words = nodes.map(node => node.textContent).join('');
  if (line.textContent === words) return;
  if (nodes.length === 1 && !(nodes[0] instanceof Element)) say(line, words);
  else line.replaceChildren(...nodes);
}
