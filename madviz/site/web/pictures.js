/**
 * Draws a scene from any place, as MuJoCo's classic renderer does, in WebGL2.
 *
 * What MuJoCo's `fast` profile leaves out (shadows, reflections, smoothing) is left out here. Shapes
 * are drawn in the order in which MuJoCo draws them, because of two that lie in one plane the later
 * one is seen. Depth comes in the fourth number of every pixel, already coded as a policy gets it.
 *
 *     all cameras into one buffer, one under the other  ->  one read-back  ->  a picture each
 */
import {bind, compiled, corners, fill, numbersTexture, uploaded} from './gl.js';
import {MATERIAL_TEXELS, MOST_LIGHTS, POSE_TEXELS} from './shaders.js';

/** @typedef {import('./scene.js').Scene} Scene */
/** @typedef {import('./scene.js').Shape} Shape */
/** @typedef {import('./messages.js').Picture} Picture */

/**
 * A place to look from. Rows of `rotation` are the world's axes, its columns right, up and back.
 * @typedef {object} Eye
 * @property {ArrayLike<number>} position Metres.
 * @property {ArrayLike<number>} rotation Nine numbers.
 * @property {number} fovy Degrees, vertical.
 * @property {[number, number]} [depth_range] Metres that are 0 and 255 in the fourth number.
 */

/** Triangles that one call draws. @typedef {{from: number, count: number, shape: number}} Part */

const FLAT = 1;
const CUBE = 2;
/** From here on a shape is opaque, as in MuJoCo. */
const OPAQUE = 0.995;
const SKY = 0.7;

export class Pictures {
  /**
   * @param {WebGL2RenderingContext} gl
   * @param {Scene} scene
   */
  constructor(gl, scene) {
    this.gl = gl;
    this.scene = scene;
    this.program = compiled(gl);
    /** @type {Map<string, WebGLUniformLocation | null>} */
    this.places = new Map();
    this.poses = numbersTexture(gl, POSE_TEXELS, scene.shapes.length);
    this.materials = numbersTexture(gl, MATERIAL_TEXELS, scene.shapes.length);
    this.textures = scene.textures.map(texture => uploaded(gl, texture));
    this.corners = corners(gl, scene);
    this.parts = parts(scene);
    // Depth as MuJoCo keeps it, 1 near and 0 far, where the browser can do that.
    this.clip = gl.getExtension('EXT_clip_control');
    this.buffer = {width: 0, height: 0, frame: gl.createFramebuffer()};
    fill(gl, this.materials, MATERIAL_TEXELS, materials(scene.shapes));
  }

  /** Frees what the driver holds. */
  close() {
    const {gl} = this;
    for (const one of [this.poses, this.materials, ...this.textures]) gl.deleteTexture(one);
    gl.deleteVertexArray(this.corners);
    gl.deleteProgram(this.program);
    gl.deleteFramebuffer(this.buffer.frame);
  }

  /**
   * Pictures of all `eyes`, square, upright, with coded depth as the fourth number.
   * @param {Float32Array} poses (G x 12) as `shapePoses` gives them.
   * @param {Eye[]} eyes
   * @param {number} size Pixels a side.
   * @returns {Picture[]}
   */
  views(poses, eyes, size) {
    const {gl} = this;
    this.resize(size, size * eyes.length);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.buffer.frame);
    this.place(poses);
    this.clear();
    eyes.forEach((eye, i) => this.draw(eye, 0, i * size, size, size));
    const bytes = new Uint8ClampedArray(4 * size * size * eyes.length);
    gl.readPixels(0, 0, size, size * eyes.length, gl.RGBA, gl.UNSIGNED_BYTE,
      new Uint8Array(bytes.buffer));
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return eyes.map((_, i) => upright(bytes, i, size));
  }

  /**
   * Draws one picture into what is bound, for example the canvas.
   * @param {Float32Array} poses
   * @param {Eye} eye
   * @param {number} width Pixels.
   * @param {number} height
   */
  show(poses, eye, width, height) {
    this.place(poses);
    this.clear();
    this.draw(eye, 0, 0, width, height);
  }

  /** @param {Float32Array} poses */
  place(poses) {
    const rows = new Float32Array(poses.length);
    for (let i = 0; i < poses.length; i += 12) {
      for (let row = 0; row < 3; row++) {
        rows.set(poses.subarray(i + 3 + 3 * row, i + 6 + 3 * row), i + 4 * row);
        rows[i + 4 * row + 3] = poses[i + row];
      }
    }
    fill(this.gl, this.poses, POSE_TEXELS, rows);
    this.where = poses;
  }

  /**
   * @param {Eye} eye
   * @param {number} left
   * @param {number} bottom
   * @param {number} width
   * @param {number} height
   */
  draw(eye, left, bottom, width, height) {
    const {gl} = this;
    gl.viewport(left, bottom, width, height);
    gl.useProgram(this.program);
    gl.bindVertexArray(this.corners);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(this.clip ? gl.GEQUAL : gl.LEQUAL);
    gl.enable(gl.CULL_FACE);
    this.look(eye, width / height);
    bind(gl, 0, gl.TEXTURE_2D, this.poses);
    bind(gl, 1, gl.TEXTURE_2D, this.materials);
    const [opaque, clear] = this.split(eye);
    gl.uniform1f(this.uniform('opacity'), 1);
    for (const part of opaque) this.call(part);
    this.transparent(eye, clear);
  }

  /**
   * MuJoCo draws what is transparent twice: nearest first, and nearest last.
   * @param {Eye} eye
   * @param {{part: Part, behind: boolean, distance: number}[]} shapes
   */
  transparent(eye, shapes) {
    if (shapes.length === 0) return;
    const {gl} = this;
    const order = [...shapes].sort((a, b) => a.distance - b.distance);
    gl.depthMask(false);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ZERO, gl.ONE);
    gl.uniform2f(this.uniform('depthRange'), 0, 0);
    for (const {part, behind} of [...order, ...order.reverse()]) {
      gl.cullFace(behind ? gl.FRONT : gl.BACK);
      gl.uniform1f(this.uniform('opacity'), behind ? 0.3 : 1);
      this.call(part);
    }
    gl.cullFace(gl.BACK);
    gl.disable(gl.BLEND);
    gl.depthMask(true);
  }

  /**
   * What is opaque from there, and what is not.
   * @param {Eye} eye
   * @returns {[Part[], {part: Part, behind: boolean, distance: number}[]]}
   */
  split(eye) {
    /** @type {Part[]} */
    const opaque = [];
    const clear = [];
    for (const part of this.parts) {
      const shape = this.scene.shapes[part.shape];
      const pose = this.where?.subarray(12 * part.shape, 12 * part.shape + 12) ?? new Float32Array(12);
      const way = [0, 1, 2].map(axis => eye.position[axis] - pose[axis]);
      const behind = shape.plane && way[0] * pose[5] + way[1] * pose[8] + way[2] * pose[11] < 0;
      if (shape.rgba[3] >= OPAQUE && !behind) {
        opaque.push(part);
      } else {
        const distance = shape.plane ? 1e10 : Math.hypot(...way) - shape.radius;
        clear.push({part, behind, distance});
      }
    }
    return [opaque, clear];
  }

  /** @param {Part} part */
  call({from, count, shape}) {
    const {gl} = this;
    const {texture, body} = this.scene.shapes[shape];
    gl.uniform1f(this.uniform('sky'), body === -1 ? SKY * this.scene.far : 0);
    const kind = texture === null ? 0 : this.scene.textures[texture].cube ? CUBE : FLAT;
    gl.uniform1i(this.uniform('texturing'), kind);
    if (texture !== null) {
      const target = kind === CUBE ? gl.TEXTURE_CUBE_MAP : gl.TEXTURE_2D;
      bind(gl, kind === CUBE ? 3 : 2, target, this.textures[texture]);
    }
    gl.drawElements(gl.TRIANGLES, 3 * count, gl.UNSIGNED_SHORT, 6 * from);
  }

  /**
   * @param {Eye} eye
   * @param {number} aspect
   */
  look(eye, aspect) {
    const {gl, scene} = this;
    const turn = eye.rotation;
    const ahead = [-turn[2], -turn[5], -turn[8]];
    const [low, high] = eye.depth_range ?? [0, 0];
    gl.uniform1i(this.uniform('poses'), 0);
    gl.uniform1i(this.uniform('materials'), 1);
    gl.uniform1i(this.uniform('flat2d'), 2);
    gl.uniform1i(this.uniform('cube'), 3);
    gl.uniformMatrix4fv(this.uniform('projection'), false, projection(eye, aspect, scene, this.clip !== null));
    gl.uniform3f(this.uniform('eye'), eye.position[0], eye.position[1], eye.position[2]);
    gl.uniform3f(this.uniform('ahead'), ahead[0], ahead[1], ahead[2]);
    gl.uniform2f(this.uniform('depthRange'), low, high);
    const lights = scene.lights.slice(0, MOST_LIGHTS);
    gl.uniform1i(this.uniform('lights'), lights.length);
    lights.forEach((light, i) => {
      const from = light.headlight ? ahead : light.direction;
      const length = Math.hypot(...from);
      gl.uniform3fv(this.uniform(`light[${i}].towards`), from.map(value => -value / length));
      gl.uniform3fv(this.uniform(`light[${i}].ambient`), light.ambient);
      gl.uniform3fv(this.uniform(`light[${i}].diffuse`), light.diffuse);
      gl.uniform3fv(this.uniform(`light[${i}].specular`), light.specular);
    });
  }

  clear() {
    const {gl, clip} = this;
    clip?.clipControlEXT(clip.LOWER_LEFT_EXT, clip.ZERO_TO_ONE_EXT);
    gl.clearColor(0, 0, 0, 1);
    gl.clearDepth(clip ? 0 : 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  }

  /** @param {string} name */
  uniform(name) {
    let place = this.places.get(name);
    if (place === undefined) {
      place = this.gl.getUniformLocation(this.program, name);
      this.places.set(name, place);
    }
    return place;
  }

  /**
   * @param {number} width
   * @param {number} height
   */
  resize(width, height) {
    const {gl, buffer} = this;
    if (buffer.width === width && buffer.height === height) return;
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer.frame);
    /** @type {[number, number][]} */
    const kinds = [
      [gl.COLOR_ATTACHMENT0, gl.RGBA8],
      [gl.DEPTH_ATTACHMENT, gl.DEPTH_COMPONENT32F],
    ];
    for (const [attachment, format] of kinds) {
      const storage = gl.createRenderbuffer();
      gl.bindRenderbuffer(gl.RENDERBUFFER, storage);
      gl.renderbufferStorage(gl.RENDERBUFFER, format, width, height);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, attachment, gl.RENDERBUFFER, storage);
    }
    Object.assign(buffer, {width, height});
  }
}

/**
 * From the world to the picture: 16 numbers, column by column.
 * @param {Eye} eye
 * @param {number} aspect Width by height.
 * @param {{near: number, far: number}} range Metres.
 * @param {boolean} [reversed] Depth from 1 to 0, not from -1 to 1.
 */
export function projection({position, rotation, fovy}, aspect, {near, far}, reversed = false) {
  const up = 1 / Math.tan(fovy * Math.PI / 360);
  const scale = [up / aspect, up];
  const [a, b] = reversed
    ? [near / (far - near), far * near / (far - near)]
    : [(far + near) / (near - far), 2 * far * near / (near - far)];
  const matrix = new Float32Array(16);
  for (let column = 0; column < 4; column++) {
    // The world seen from the eye: right, up, back.
    const seen = [0, 1, 2].map(axis => {
      if (column < 3) return rotation[3 * column + axis];
      return -[0, 1, 2].reduce((sum, row) => sum + rotation[3 * row + axis] * position[row], 0);
    });
    matrix[4 * column] = scale[0] * seen[0];
    matrix[4 * column + 1] = scale[1] * seen[1];
    matrix[4 * column + 2] = a * seen[2] + (column === 3 ? b : 0);
    matrix[4 * column + 3] = -seen[2];
  }
  return matrix;
}

/**
 * Runs of shapes with the same texture, in MuJoCo's order; planes and what is transparent alone.
 * @param {Scene} scene
 * @returns {Part[]}
 */
function parts(scene) {
  /** @type {Part[]} */
  const found = [];
  const alone = (/** @type {Shape} */ {plane, rgba, body}) =>
    plane || rgba[3] < OPAQUE || body === -1;
  scene.shapes.forEach((shape, number) => {
    const [from, count] = shape.triangles;
    const last = found[found.length - 1];
    const before = last && scene.shapes[last.shape];
    if (last && before.texture === shape.texture && !alone(before) && !alone(shape)) {
      last.count += count;
    } else {
      found.push({from, count, shape: number});
    }
  });
  return found;
}

/** @param {Shape[]} shapes */
function materials(shapes) {
  const rows = shapes.map(shape => [
    ...shape.rgba,
    ...[shape.emission, shape.specular, shape.shininess, 0],
    ...[...shape.texture_scale, 0],
    ...[...shape.texture_shift, 0],
  ]);
  return new Float32Array(rows.flat());
}

/**
 * OpenGL's first row is the bottom one.
 * @param {Uint8ClampedArray} bytes
 * @param {number} number
 * @param {number} size
 * @returns {Picture}
 */
function upright(bytes, number, size) {
  const rgba = new Uint8ClampedArray(4 * size * size);
  const row = 4 * size;
  for (let i = 0; i < size; i++) {
    const from = (number * size + size - 1 - i) * row;
    rgba.set(bytes.subarray(from, from + row), i * row);
  }
  return {width: size, height: size, rgba};
}
