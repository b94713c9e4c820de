/**
 * The worker's one OpenGL context, and the scenes that were uploaded to it.
 *
 * A driver may take a context away at any moment, also between two drawings of one picture. From
 * then on every picture is black, and a policy that acts on one does what it would never do. So
 * pictures are drawn again when the context is back, and until then their caller waits. Everything
 * that was in the context is gone then, and is uploaded again.
 */
import {Pictures} from './pictures.js';

/** @typedef {import('./pictures.js').Eye} Eye */
/** @typedef {import('./pictures.js').Picture} Picture */
/** @typedef {import('./scene.js').Scene} Scene */

/** Scenes that stay uploaded: one for each task that was shown last. */
const MOST = 3;

export class Drawing {
  /** @param {() => void} onLost Called when the context was taken away. */
  constructor(onLost) {
    /** @type {Map<Scene, Pictures>} */
    this.made = new Map();
    this.canvas = new OffscreenCanvas(8, 8);
    this.canvas.addEventListener('webglcontextlost', event => {
      event.preventDefault(); // Without this it never comes back.
      onLost();
    });
    this.canvas.addEventListener('webglcontextrestored', () => this.made.clear());
    this.gl = this.canvas.getContext('webgl2', {antialias: false});
  }

  /** Who draws, in the driver's words. */
  get backend() {
    const {gl} = this;
    const info = gl?.getExtension('WEBGL_debug_renderer_info');
    return gl ? gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER) : '';
  }

  /**
   * Pictures as `Pictures.views` draws them. Throws an Error where there is no WebGL2.
   * @param {Scene} scene
   * @param {Float32Array} poses
   * @param {Eye[]} eyes
   * @param {number} size
   * @returns {Promise<Picture[]>}
   */
  async views(scene, poses, eyes, size) {
    const {gl} = this;
    if (!gl) throw new Error('This browser has no WebGL2 in workers; try another browser.');
    for (;;) {
      await this.present(gl);
      try {
        const drawn = this.of(gl, scene).views(poses, eyes, size);
        if (!gl.isContextLost()) return drawn;
      } catch (error) {
        if (!gl.isContextLost()) throw error;
      }
    }
  }

  /**
   * Waits while there is no context.
   * @param {WebGL2RenderingContext} gl
   */
  async present(gl) {
    while (gl.isContextLost()) {
      await new Promise(resolve =>
        this.canvas.addEventListener('webglcontextrestored', resolve, {once: true}));
    }
  }

  /**
   * @param {WebGL2RenderingContext} gl
   * @param {Scene} scene
   */
  of(gl, scene) {
    let found = this.made.get(scene);
    if (!found) {
      found = new Pictures(gl, scene);
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
}
