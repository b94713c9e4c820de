/**
 * A box that is dragged on a camera's picture, as shares of it: it becomes a black patch.
 *
 * With a finger, a drag scrolls the page, so it takes a mouse or a pen; sliders do the same.
 */

import {make} from './dom.js';

/** @typedef {{x: number, y: number, width: number, height: number}} Box Middle and sides. */

const SHORTEST = 8; // Pixels on the screen: a shorter drag is a click with an unsteady hand.
const THINNEST = 2;

/**
 * @param {HTMLElement} picture
 * @param {(box: Box) => void} onBox
 */
export function dragBoxes(picture, onBox) {
  const band = make('div', {class: 'band', hidden: true});
  picture.append(band);
  /** @type {{x: number, y: number} | null} */
  let start = null;
  /** @param {PointerEvent} event */
  const at = event => {
    const area = picture.getBoundingClientRect();
    return {x: share((event.clientX - area.left) / area.width),
      y: share((event.clientY - area.top) / area.height), area};
  };
  const end = () => { start = null; band.hidden = true; };
  picture.addEventListener('pointerdown', event => {
    if (event.button !== 0 || event.pointerType === 'touch') return;
    start = at(event);
    picture.setPointerCapture(event.pointerId);
    event.preventDefault();
  });
  picture.addEventListener('pointermove', event => {
    if (!start) return;
    const box = spanned(start, at(event));
    band.hidden = !box.large;
    band.style.left = `${100 * (box.x - box.width / 2)}%`;
    band.style.top = `${100 * (box.y - box.height / 2)}%`;
    band.style.width = `${100 * box.width}%`;
    band.style.height = `${100 * box.height}%`;
  });
  picture.addEventListener('pointerup', event => {
    const box = start && spanned(start, at(event));
    end();
    if (box?.large) onBox({x: box.x, y: box.y, width: box.width, height: box.height});
  });
  picture.addEventListener('pointercancel', end);
  addEventListener('keydown', event => { if (event.key === 'Escape') end(); });
}

/** @param {number} value */
function share(value) {
  return Math.min(Math.max(value, 0), 1);
}

/**
 * @param {{x: number, y: number}} from
 * @param {{x: number, y: number, area: DOMRect}} to
 */
function spanned(from, to) {
  const width = Math.abs(to.x - from.x), height = Math.abs(to.y - from.y);
  const [wide, high] = [width * to.area.width, height * to.area.height];
  return {x: (from.x + to.x) / 2, y: (from.y + to.y) / 2, width, height,
    large: Math.max(wide, high) >= SHORTEST && Math.min(wide, high) >= THINNEST};
}
