/**
 * The worker's one OpenGL context, and the scenes that were uploaded to it.
 *
 * A driver may take a context away at any moment; when it gives it back, everything that was in it
 * is gone and is uploaded again. Until then nothing moves.
 */
import {Pictures} from './pictures.js';

/** @typedef {import('./scene.js').Scene} Scene */

/** Scenes that stay uploaded: one for each task that was shown last. */
const MOST = 3;

export class Drawing {
  /** @param {() => void} renewed Called when a lost context is back. */
  constructor(renewed) {
    this.lost = false;
    /** @type {Map<Scene, Pictures>} */
    this.made = new Map();
    this.canvas = new OffscreenCanvas(8, 8);
    this.canvas.addEventListener('webglcontextlost', event => {
      event.preventDefault();
      this.lost = true;
    });
    this.canvas.addEventListener('webglcontextrestored', () => {
      this.lost = false;
      this.made.clear();
      renewed();
    });
    this.gl = this.canvas.getContext('webgl2', {antialias: false});
  }

  /** Who draws, in the driver's words. */
  get backend() {
    const {gl} = this;
    const info = gl?.getExtension('WEBGL_debug_renderer_info');
    return gl ? gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER) : '';
  }

  /**
   * Throws an Error where there is no WebGL2.
   * @param {Scene} scene
   * @returns {Pictures}
   */
  of(scene) {
    if (!this.gl) throw new Error('This browser has no WebGL2 in workers; try another browser.');
    let found = this.made.get(scene);
    if (!found) {
      found = new Pictures(this.gl, scene);
      this.made.set(scene, found);
      if (this.made.size > MOST) this.forget();
    }
    return found;
  }

  forget() {
    const [oldest] = this.made.keys();
    this.made.get(oldest)?.close();
    this.made.delete(oldest);
  }

  /** For tests. */
  lose() {
    const loser = this.gl?.getExtension('WEBGL_lose_context');
    loser?.loseContext();
    setTimeout(() => loser?.restoreContext(), 500);
  }
}
