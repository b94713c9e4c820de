/**
 * The first scene: two policies and the same start, in three acts: all cameras; one that goes black
 * in both; the same with the guard. Where no guard is fitted or episodes are recorded, it has one
 * act, in which the camera goes off.
 *
 * What is said is read from frames as they come: by how much the action changed, how it ended, and
 * what was measured over many episodes. Nothing here knows in advance who succeeds.
 */

import {intact, noOcclusion} from './camera_state.js';
import {make, say} from './dom.js';
import {endingOf, guessWords} from './ending.js';
import {effectWords, guardWords, labelOf} from './words.js';

/** @typedef {import('./messages.js').Frame} Frame */

/** @typedef {import('./catalogue.js').Opening} Opening */

export const SPEED = 10;

/**
 * An act: how the camera fails, whether the visitor guesses before it, whether a guard watches.
 * @typedef {{how: '' | 'off' | 'black', asks: boolean, guard: boolean}} Act
 */

/** @param {Opening} opening @returns {Act[]} */
export function acts({entries}) {
  const asks = entries.length > 1;
  if (!entries.every(entry => entry.guard)) return [{how: 'off', asks, guard: false}];
  return [{how: '', asks: false, guard: false}, {how: 'black', asks, guard: false},
    {how: 'black', asks: false, guard: true}];
}

/**
 * @param {Opening} opening
 * @param {Act} act
 * @returns {import('./messages.js').ScheduledEvent[]}
 */
export function openingEvents({camera, step}, {how}) {
  if (!how) return [];
  const state = how === 'off' ? {input: /** @type {const} */ ('off'), occlusion: noOcclusion()}
    : {...intact(), occlusion: {...noOcclusion(), kind: how}};
  return [{step, side: 'both', camera, state}];
}

/** @param {Opening} opening @param {Act} act */
export function headline({entries, camera}, {how, guard}) {
  const who = entries.length > 1 ? 'Two policies, the same start' : 'One robot, several cameras';
  const label = labelOf(camera, entries[0].cameras);
  if (guard) return `${who}: ${label} goes black, and a guard leaves it out`;
  return {'': `${who}, and all cameras`, off: `${who}, and one camera goes off`,
    black: `${who}: ${label} goes black`}[how];
}

/** What leads on to an act. @param {Opening} opening @param {Act} act */
export function leadsOn({entries, camera}, {guard}) {
  return guard ? 'Next: the same with the guard'
    : `Next: ${labelOf(camera, entries[0].cameras)} goes black`;
}

/**
 * The line under the headline.
 * @param {Frame} frame
 * @param {Opening} opening
 * @param {import('./statistics.js').Tally} tally
 * @param {{asks: boolean, guess: string}} visitor
 * @param {Act} act
 * @returns {Node[]}
 */
export function story(frame, {entries, step, camera: name}, tally, {asks, guess}, {how, guard}) {
  const worlds = [frame.first, ...(frame.second ? [frame.second] : [])];
  const camera = labelOf(name, entries[0].cameras), {cameras, task_label} = entries[0];
  const noticed = guardWords(frame.first, cameras);
  if (frame.first.ended) {
    return [...endingNodes(endingOf(worlds, entries, tally), guess), text(noticed && ` ${noticed}`)];
  }
  const event = how === 'off' ? `${camera} goes off`
    : `${camera} goes black${guard ? '' : ', and stays in the sum'}`;
  if (asks && frame.first.step === 0) {
    return [strong(`${task_label}. `), text(`At step ${step}, ${event}, on both sides. `
      + 'Which policy will still do it?')];
  }
  if (!how || frame.first.step < step) {
    const watched = guard ? 'A guard watches the pictures, and leaves out a camera that fails. ' : '';
    return [strong(`${task_label}. `),
      text(`${entries.length > 1 ? 'Both policies see the same' : 'The policy sees'} `
      + `${cameras.length} cameras. ${watched}${how ? `At step ${step}, ${event}.` : ''}`)];
  }
  const effects = worlds.map((world, i) => world.change
    ? `${entries[i].label}: ${effectWords(world.change)}` : '').filter(Boolean);
  return [strong(`Step ${step}: ${camera} ${how === 'off' ? 'is off' : 'sends black'}. `),
    text([effects.length ? `${effects.join('. ')}.` : '', noticed].filter(Boolean).join(' '))];
}

/** @param {ReturnType<typeof endingOf>} parts @param {string} [guess] @returns {Node[]} */
export function endingNodes(parts, guess = '') {
  return parts ? [text(parts.done ? `${parts.done} ` : ''), strong(parts.result),
    text(guess ? ` ${guessWords(guess, parts.winners)}` : ''),
    ...parts.cameOfIt ? [text(` ${parts.cameOfIt}`), make('span', {class: 'soft'},
      ' Thick line: its path; thin: with all cameras.')] : [], text(` ${parts.measured}`)] : [];
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
