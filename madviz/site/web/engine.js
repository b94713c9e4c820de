/**
 * Who answers the page's commands: the worker that simulates, or a player of recordings.
 *
 * Both take the same commands and give the same frames, so the page does not know which one it is.
 */

import {Player} from './player.js';

/** @typedef {import('./messages.js').Answer} Answer */
/** @typedef {import('./messages.js').Command} Command */
/** @typedef {import('./messages.js').Manifest} Manifest */
/** @typedef {{post: (command: Command) => void, stop: () => void}} Engine */

/** The site's folder, as an address that ends with a slash. */
export const BASE = new URL('./', import.meta.url).href;

/**
 * @param {boolean} recorded
 * @param {Manifest} manifest
 * @param {(answer: Answer) => void} onAnswer
 * @returns {Engine}
 */
export function startEngine(recorded, manifest, onAnswer) {
  return recorded ? new Player(BASE, manifest, onAnswer) : startWorker(onAnswer);
}

/**
 * @param {(answer: Answer) => void} onAnswer
 * @returns {Engine}
 */
function startWorker(onAnswer) {
  const worker = new Worker(new URL('./worker.js', import.meta.url), {type: 'module'});
  worker.onmessage = event => onAnswer(event.data);
  worker.onerror = event => {
    event.preventDefault();
    const what = event.message ? `: ${event.message}` : ' and says no more';
    onAnswer({kind: 'Problem', fatal: true,
      message: `The simulation stopped${what}. Load the page again to start anew.`});
  };
  return {post: command => worker.postMessage(command), stop: () => worker.terminate()};
}

/**
 * What this browser lacks for a simulation.
 * @returns {string} A sentence, or '' where nothing is missing.
 */
export function missing() {
  const lacks = [];
  if (typeof WebAssembly !== 'object') lacks.push('WebAssembly');
  if (typeof Worker !== 'function') lacks.push('workers');
  if (typeof DecompressionStream !== 'function') lacks.push('DecompressionStream');
  const drawn = typeof OffscreenCanvas === 'function' && new OffscreenCanvas(1, 1);
  if (!drawn || !drawn.getContext('webgl2')) lacks.push('WebGL2');
  if (lacks.length === 0) return '';
  return `This browser has no ${lacks.join(' and no ')}, which the simulation needs. Another `
    + 'browser, a newer version, or hardware acceleration switched on in its settings may help.';
}

/** Whether OpenGL is computed by the CPU here, as far as the browser says. */
export function onCpu() {
  const gl = typeof OffscreenCanvas === 'function' && new OffscreenCanvas(1, 1).getContext('webgl2');
  const info = gl && gl.getExtension('WEBGL_debug_renderer_info');
  const name = info ? String(gl.getParameter(info.UNMASKED_RENDERER_WEBGL)) : '';
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
}
