/** Making elements, in one line each. Text is always text: nothing of a file or a link is markup. */

/**
 * @template {keyof HTMLElementTagNameMap} K
 * @param {K} tag
 * @param {Record<string, string | boolean | number | EventListener>} [attributes] `class`, `aria-…`,
 *   `on…` listeners; false leaves one out.
 * @param {...(Node | string)} children
 * @returns {HTMLElementTagNameMap[K]}
 */
export function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (typeof value === 'function') element.addEventListener(name.slice(2), value);
    else if (value !== false) element.setAttribute(name, value === true ? '' : String(value));
  }
  element.append(...children);
  return element;
}

/**
 * The element with this id, which index.html has.
 * @param {string} id
 * @returns {HTMLElement}
 */
export function byId(id) {
  const element = document.getElementById(id);
  if (!element) throw new Error(`index.html has no #${id}`);
  return element;
}

/** @type {Record<string, string>} The vocabulary's sentences, from the manifest. */
const meanings = {};

/** @param {Record<string, string>} [words] */
export function setMeanings(words = {}) {
  Object.assign(meanings, words);
}

/**
 * A word of the vocabulary: its sentence is shown on hover and focus.
 * @param {string} word
 * @param {string} [label] What stands there, if it is not the word.
 */
export function term(word, label = word) {
  const says = meanings[word];
  if (!says) return make('span', {}, label);
  return make('span', {class: 'term', tabindex: 0, 'aria-description': says, 'data-says': says},
    label);
}

/**
 * Sets text only where it changes: what is set again is read again by a screen reader.
 * @param {Element} element
 * @param {string} text
 */
export function say(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Whether the visitor asked for less motion. */
export function calm() {
  return matchMedia('(prefers-reduced-motion: reduce)').matches;
}
