/** Six sliders that move a camera along its own axes; the policy sees the picture from there. */

import {make} from './dom.js';

/** @typedef {import('./messages.js').Displacement} Displacement */

/** @type {[keyof Displacement, string, number, number, number][]} */
const AXES = [['forward', 'forward, m', -0.3, 0.3, 0.01], ['right', 'right, m', -0.3, 0.3, 0.01],
  ['up', 'up, m', -0.3, 0.3, 0.01], ['pan', 'turn right, °', -45, 45, 1],
  ['tilt', 'turn up, °', -45, 45, 1], ['zoom', 'zoom', 0.5, 2, 0.05]];

/** @returns {Displacement} */
export function noMove() {
  return {forward: 0, right: 0, up: 0, pan: 0, tilt: 0, zoom: 1};
}

/**
 * @param {string} label Of the camera.
 * @param {(move: Displacement | null) => void} onMove Null: back to its place.
 */
export function moveBox(label, onMove) {
  let now = noMove();
  const sliders = AXES.map(([name, text, min, max, step]) => {
    const slider = make('input', {type: 'range', min, max, step, 'aria-label': `${label}: ${text}`,
      oninput: () => {
        now = {...now, [name]: Number(slider.value)};
        onMove(now);
      }});
    return {name, slider, row: make('label', {}, make('span', {}, text), slider)};
  });
  const back = make('button', {type: 'button', onclick: () => onMove(null)}, 'Put it back');
  const element = make('div', {class: 'sliders'}, ...sliders.map(one => one.row), back);
  /** @param {Displacement | undefined} move */
  const update = move => {
    now = move ?? noMove();
    back.disabled = !move;
    for (const {name, slider} of sliders) {
      if (document.activeElement !== slider) slider.value = String(now[name]);
    }
  };
  return {element, update};
}
