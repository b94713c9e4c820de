/** Lesson 0: a prediction, the robots in a frame, and two exercises that check themselves. */

import {byId, make, say} from './dom.js';
import {HINTS, linkLacks, MAD, MERGED_ONLY, ratesLack} from './lesson_checks.js';

const OPENING = `./?embed#policy=${MAD}&vs=${MERGED_ONLY}&first=off@15`;
const DONE = 'First person was dropped at step 15.';
const NOTHING = 'nothing yet';

/**
 * Shows what an answer lacks, with one hint more each time.
 * @param {string} id @param {string[]} hints
 * @param {(typed: (name: string) => string) => string | Promise<string>} judge
 */
function exercise(id, hints, judge) {
  const form = /** @type {HTMLFormElement} */ (byId(id));
  const words = /** @type {Element} */ (form.querySelector('[role=status]'));
  let failed = 0;
  form.addEventListener('submit', async event => {
    event.preventDefault();
    const typed = new FormData(form);
    const lacks = await judge(name => String(typed.get(name) ?? ''));
    form.classList.toggle('right', lacks === '');
    if (lacks) failed = Math.min(failed + 1, hints.length);
    const shown = hints.slice(0, failed).map((hint, i) => `Hint ${i + 1} of ${hints.length}: ${hint}`);
    say(words, lacks ? [lacks, ...shown].join('\n') : 'Right.');
  });
}

/** Success by subset of both policies, from the site's own list. */
async function measured() {
  const manifest = await (await fetch('manifest.json')).json();
  /** @type {{name?: string, policy?: string, measured: import('./lesson_checks.js').Measured}[]} */
  const all = [...manifest.policies, ...manifest.recordings];
  return Object.fromEntries(all.map(one => [one.name ?? one.policy, one.measured]));
}

/**
 * Says how both episodes ended, and whether that was predicted. What is tried in the frame afterwards
 * was not.
 * @param {Document} inside The page in the frame.
 * @param {string} guess
 */
function compare(inside, guess) {
  const line = inside.getElementById('line');
  const winners = inside.querySelectorAll('.outcome.good').length;
  const ended = winners + inside.querySelectorAll('.outcome.bad').length;
  if (ended < 2 || !line?.textContent?.startsWith(DONE)) return;
  const came = winners === 1 ? 'One goes on, the other fails' : winners ? 'Both go on' : 'Both fail';
  say(byId('said'), `${DONE} ${line.querySelector('b')?.textContent} You predicted: ${guess}${
    guess === NOTHING ? '.' : guess === came ? ', and so it was.' : `, and it was: ${came}.`}`);
}

byId('open').addEventListener('click', () => {
  const checked = document.querySelector('input[name=guess]:checked');
  const guess = checked instanceof HTMLInputElement ? checked.value : NOTHING;
  say(byId('said'), `You predicted: ${guess}.`);
  const frame = /** @type {HTMLIFrameElement} */ (make('iframe', {src: OPENING, title: 'Two robots'}));
  frame.addEventListener('load', () => {
    const inside = frame.contentDocument, line = inside?.getElementById('line');
    if (!inside || !line) return;
    new MutationObserver(() => compare(inside, guess)).observe(line, {childList: true});
  });
  byId('robots').replaceChildren(frame);
});
exercise('rates', HINTS.rates, async typed => {
  try {
    return ratesLack(typed('mad'), typed('merged'), await measured());
  } catch {
    return 'This site does not have the two policies of the lesson.';
  }
});
exercise('link', HINTS.link, typed => linkLacks(typed('link')));
