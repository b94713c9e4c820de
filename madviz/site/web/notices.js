/** Sentences about what went wrong, which stay until they are closed; the page goes on under them. */

import {byId, make} from './dom.js';

const MOST = 4;

/**
 * @param {string} words
 * @param {{words: string, act: () => void}} [offer] A button, for what can be done about it.
 */
export function notice(words, offer) {
  const box = byId('notices');
  if ([...box.children].some(one => one.firstElementChild?.textContent === words)) return;
  const close = make('button', {type: 'button', 'aria-label': 'Close this message',
    onclick: () => element.remove()}, '×');
  const buttons = offer ? [make('button', {type: 'button', onclick: () => {
    element.remove();
    offer.act();
  }}, offer.words)] : [];
  const element = make('div', {class: 'notice'}, make('span', {}, words), ...buttons, close);
  box.append(element);
  while (box.children.length > MOST) box.firstElementChild?.remove();
}
