/**
 * The scene from a point of view that a visitor turns, with the cameras as frusta in their colours.
 *
 * One OpenGL context draws for both sides, so that the scene is in memory once; each picture is
 * copied to its side's canvas, and lines go over it. Drawing may take longer than a decision where
 * OpenGL runs on the CPU: then it takes a fifth of the time at most, and the corner says its rate.
 */

import {cameraColourNow} from './colours.js';
import {say} from './dom.js';
import {onCpu} from './engine.js';
import {frustum, lineOnCanvas, viewpoint} from './geometry.js';
import {Pictures} from './pictures.js';
import {parseScene} from './scene.js';

/** @typedef {import('./messages.js').World} World */
/** @typedef {import('./geometry.js').Orbit} Orbit */
/** @typedef {{world: World, side: import('./side.js').Side}} Seen */

const LEAST = 40; // Milliseconds from one drawing to the next.
const SHARE = 4; // Times as long as a drawing takes, nothing is drawn.
const LENGTH = 0.12; // Metres of a frustum; one on the hand is shorter.
const TAKEN = [['#000a', 6], ['#ffd166', 4]]; // The hand's path: colours, and pixels wide.
const INTACT = [['#000a', 3.5], ['#fff', 2]]; // Its path with all cameras.
const WIDEST = 900; // Pixels.
const WIDEST_SLOW = 360; // Where OpenGL runs on the CPU.

/** @returns {Orbit} */
function start() {
  return {target: [0.22, 0.42, 0.42], distance: 2.35, azimuth: -68, elevation: 22, fovy: 45};
}

export class SceneView {
  /** @param {(words: string) => void} onProblem */
  constructor(onProblem) {
    this.onProblem = onProblem;
    this.slow = onCpu();
    this.orbit = start();
    /** @type {Map<string, {buffer: ArrayBuffer, textures: ArrayBuffer[]}>} By task. */
    this.buffers = new Map();
    /** @type {import('./pictures.js').Pictures | null} For `task`. */
    this.pictures = null;
    this.task = '';
    this.canvas = document.createElement('canvas');
    /** @type {WebGL2RenderingContext | null} */
    this.gl = null;
    this.broken = false;
    this.last = 0;
    this.cost = 0;
    this.rate = 0;
    /** @type {Seen[]} */
    this.seen = [];
    this.asked = false;
    this.canvas.addEventListener('webglcontextlost', event => {
      event.preventDefault();
      this.pictures = null;
      onProblem('The graphics driver took the 3D view away. It comes back when the driver does.');
    });
    this.canvas.addEventListener('webglcontextrestored', () => this.wake());
  }

  /** @param {string} task @param {ArrayBuffer} buffer @param {ArrayBuffer[]} textures */
  addScene(task, buffer, textures) {
    this.buffers.set(task, {buffer, textures});
    this.wake();
  }

  /** @param {Seen[]} seen What is to be drawn next. */
  show(seen) {
    this.seen = seen;
    this.wake();
  }

  wake() {
    if (this.asked || this.broken || document.hidden) return;
    this.asked = true;
    const wait = Math.max(LEAST, SHARE * this.cost) - (performance.now() - this.last);
    setTimeout(() => requestAnimationFrame(() => {
      this.asked = false;
      try {
        this.draw();
      } catch (error) {
        this.broken = true;
        this.onProblem(`The 3D view cannot be drawn here (${error}); the rest works.`);
      }
    }), Math.max(wait, 0));
  }

  draw() {
    for (const {world, side} of this.seen) if (world.scene) film(side, world.scene);
    const task = this.seen[0]?.world.task;
    if (!task || this.seen[0].world.scene || !this.prepare(task)) return;
    const begin = performance.now();
    for (const {world, side} of this.seen) if (world.geom_poses.length) this.drawSide(world, side);
    const now = performance.now();
    this.cost = 0.7 * this.cost + 0.3 * (now - begin);
    this.rate = 0.7 * this.rate + 0.3 * (1000 / Math.max(now - this.last, 1));
    this.last = now;
    for (const {side} of this.seen) say(side.hint, `scene drawn ${this.rate.toFixed(0)} × a second`);
  }

  /** @param {string} task @returns {boolean} Whether its scene is there. */
  prepare(task) {
    if (this.pictures && this.task === task) return true;
    const files = this.buffers.get(task);
    if (!files) return false;
    this.gl ??= this.canvas.getContext('webgl2', {antialias: !this.slow, preserveDrawingBuffer: true});
    if (!this.gl) throw new Error('WebGL2 is missing');
    this.pictures = new Pictures(this.gl, parseScene(files.buffer, files.textures));
    this.task = task;
    return true;
  }

  /** @param {World} world @param {import('./side.js').Side} side */
  drawSide(world, side) {
    const area = side.canvas.getBoundingClientRect();
    const scale = Math.min(devicePixelRatio || 1, WIDEST / Math.max(area.width, 1));
    resize(side.canvas, area.width * scale, area.height * scale);
    // Lines and names stay sharp where the scene itself has fewer pixels.
    const share = this.slow ? Math.min(WIDEST_SLOW / side.canvas.width, 1) : 1;
    resize(this.canvas, side.canvas.width * share, side.canvas.height * share);
    const view = viewpoint(this.orbit);
    this.pictures?.show(world.geom_poses, view, this.canvas.width, this.canvas.height);
    const context = side.canvas.getContext('2d');
    if (!context) return;
    context.drawImage(this.canvas, 0, 0, side.canvas.width, side.canvas.height);
    this.frusta(context, world, side, view, area.width < 300 ? 0.75 * scale : scale);
    if (!world.paths) return;
    drawPath(context, world.paths.taken, TAKEN, view, scale);
    drawPath(context, world.paths.intact, INTACT, view, scale);
  }

  /** @param {CanvasRenderingContext2D} context @param {World} world
   * @param {import('./side.js').Side} side @param {import('./geometry.js').Viewpoint} view
   * @param {number} scale */
  frusta(context, world, side, view, scale) {
    const {width, height} = context.canvas;
    (side.entry?.cameras ?? []).forEach((camera, index) => {
      const pose = world.poses[camera.name];
      if (!pose) return;
      const {tip, corners, top} = frustum(pose, camera.body ? LENGTH / 2 : LENGTH);
      const off = world.cameras[camera.name]?.input === 'off';
      context.setLineDash(off ? [3 * scale, 4 * scale] : []);
      const lines = corners.flatMap((corner, i) =>
        [[tip, corner], [corner, corners[(i + 1) % 4]]]);
      lines.push([corners[0], top], [top, corners[1]]);
      const places = lines.map(([from, to]) => lineOnCanvas(from, to, view, width, height));
      for (const [colour, wide] of /** @type {[string, number][]} */ (
        [['#000a', 4], [cameraColourNow(index), 2]])) {
        context.strokeStyle = colour;
        context.lineWidth = wide * scale;
        context.beginPath();
        for (const place of places) {
          if (!place) continue;
          context.moveTo(place[0], place[1]);
          context.lineTo(place[2], place[3]);
        }
        context.stroke();
      }
      const at = world.paths && camera.body ? null : places[0]; // It would cover the paths.
      if (at && at[0] > 0 && at[0] < width && at[1] > 0 && at[1] < height) {
        name(context, off ? `${camera.label}: off` : camera.label, at, scale);
      }
    });
    context.setLineDash([]);
  }

  /**
   * Turning with pointer, wheel and keys; both sides turn together.
   * @param {HTMLCanvasElement} canvas
   */
  listen(canvas) {
    canvas.addEventListener('pointerdown', event => canvas.setPointerCapture(event.pointerId));
    canvas.addEventListener('pointermove', event => {
      if (event.buttons) this.turn(-0.4 * event.movementX, 0.3 * event.movementY, 1);
    });
    canvas.addEventListener('wheel', event => {
      if (document.activeElement !== canvas && !event.ctrlKey) return; // The page scrolls.
      event.preventDefault();
      this.turn(0, 0, Math.exp(event.deltaY / 800));
    }, {passive: false});
    canvas.addEventListener('dblclick', () => { this.orbit = start(); this.wake(); });
    canvas.addEventListener('keydown', event => {
      const turns = /** @type {Record<string, [number, number, number]>} */ ({
        ArrowLeft: [8, 0, 1], ArrowRight: [-8, 0, 1], ArrowUp: [0, 6, 1], ArrowDown: [0, -6, 1],
        '+': [0, 0, 0.9], '-': [0, 0, 1.1]});
      const turn = turns[event.key];
      if (!turn) return;
      event.preventDefault();
      this.turn(...turn);
    });
  }

  /** @param {number} azimuth @param {number} elevation Degrees. @param {number} zoom */
  turn(azimuth, elevation, zoom) {
    this.orbit.azimuth += azimuth;
    this.orbit.elevation = Math.min(Math.max(this.orbit.elevation + elevation, -10), 88);
    this.orbit.distance = Math.min(Math.max(this.orbit.distance * zoom, 0.4), 5);
    this.wake();
  }
}

/** @param {CanvasRenderingContext2D} context @param {Float32Array} path (T x 3)
 * @param {(string | number)[][]} strokes @param {import('./geometry.js').Viewpoint} view
 * @param {number} scale */
function drawPath(context, path, strokes, view, scale) {
  const {width, height} = context.canvas;
  const points = Array.from({length: path.length / 3}, (_, i) =>
    /** @type {import("./geometry.js").Point} */ ([path[3 * i], path[3 * i + 1], path[3 * i + 2]]));
  context.lineCap = 'round';
  for (const [colour, wide] of strokes) {
    context.strokeStyle = String(colour);
    context.lineWidth = Number(wide) * scale;
    context.beginPath();
    points.slice(1).forEach((to, i) => {
      const place = lineOnCanvas(points[i], to, view, width, height);
      if (!place) return;
      context.moveTo(place[0], place[1]);
      context.lineTo(place[2], place[3]);
    });
    context.stroke();
  }
  context.lineCap = 'butt';
}

/** @param {HTMLCanvasElement} canvas @param {number} width @param {number} height */
function resize(canvas, width, height) {
  const [wide, high] = [Math.max(Math.round(width), 2), Math.max(Math.round(height), 2)];
  if (canvas.width !== wide || canvas.height !== high) [canvas.width, canvas.height] = [wide, high];
}

/** @param {CanvasRenderingContext2D} context @param {string} words
 * @param {[number, number, number, number]} place Its first point is the frustum's tip.
 * @param {number} scale */
function name(context, words, [x, y], scale) {
  context.font = `600 ${12 * scale}px system-ui, sans-serif`;
  const wide = context.measureText(words).width, {width, height} = context.canvas;
  const left = Math.min(Math.max(x - wide / 2, 4), width - wide - 4);
  const base = Math.min(Math.max(y - 8 * scale, 14 * scale), height - 6);
  context.fillStyle = '#000a';
  context.fillRect(left - 4 * scale, base - 12 * scale, wide + 8 * scale, 16 * scale);
  context.fillStyle = '#fff';
  context.fillText(words, left, base);
}

/** A recorded picture of the scene. @param {import('./side.js').Side} side
 * @param {import('./messages.js').Picture} picture */
function film({canvas, hint}, {width, height, rgba}) {
  [canvas.width, canvas.height] = [width, height];
  const pixels = /** @type {Uint8ClampedArray<ArrayBuffer>} */ (rgba);
  canvas.getContext('2d')?.putImageData(new ImageData(pixels, width, height), 0, 0);
  say(hint, 'recorded');
}
