/**
 * The steps of WebGL2 that `pictures.js` takes: programs, buffers, textures.
 */
import {FRAGMENT, VERTEX} from './shaders.js';

/** @typedef {import('./scene.js').Scene} Scene */
/** @typedef {import('./scene.js').Texture} Texture */

/**
 * @param {WebGL2RenderingContext} gl
 * @returns {WebGLProgram}
 */
export function compiled(gl) {
  const program = gl.createProgram();
  /** @type {[number, string][]} */
  const halves = [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]];
  for (const [kind, source] of halves) {
    const shader = /** @type {WebGLShader} */ (gl.createShader(kind));
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
    throw new Error(`the pictures' program does not compile here: ${gl.getProgramInfoLog(program)}`);
  }
  return program;
}

/**
 * All corners and triangles of a scene, uploaded once.
 * @param {WebGL2RenderingContext} gl
 * @param {Scene} scene
 */
export function corners(gl, scene) {
  const vertices = gl.createVertexArray();
  gl.bindVertexArray(vertices);
  /** @type {[Float32Array, number][]} */
  const attributes = [[scene.positions, 3], [scene.normals, 3], [scene.numbers, 1]];
  attributes.forEach(([numbers, width], location) => {
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, numbers, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(location);
    gl.vertexAttribPointer(location, width, gl.FLOAT, false, 0, 0);
  });
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, scene.triangles, gl.STATIC_DRAW);
  gl.bindVertexArray(null);
  return vertices;
}

/**
 * A texture that holds numbers, not a picture: four in each texel.
 * @param {WebGL2RenderingContext} gl
 * @param {number} width
 * @param {number} height
 */
export function numbersTexture(gl, width, height) {
  const texture = gl.createTexture();
  bind(gl, 0, gl.TEXTURE_2D, texture);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32F, width, height);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  return texture;
}

/**
 * @param {WebGL2RenderingContext} gl
 * @param {WebGLTexture | null} texture
 * @param {number} width
 * @param {Float32Array} numbers
 */
export function fill(gl, texture, width, numbers) {
  bind(gl, 0, gl.TEXTURE_2D, texture);
  const height = numbers.length / 4 / width;
  gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, height, gl.RGBA, gl.FLOAT, numbers);
}

/**
 * A texture with every smaller level as it was shipped: a browser would round them otherwise.
 * @param {WebGL2RenderingContext} gl
 * @param {Texture} texture
 */
export function uploaded(gl, {cube, levels}) {
  const made = gl.createTexture();
  const target = cube ? gl.TEXTURE_CUBE_MAP : gl.TEXTURE_2D;
  bind(gl, 0, target, made);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
  levels.forEach(({width, height, faces}, level) => {
    for (let face = 0; face < (cube ? 6 : 1); face++) {
      const side = cube ? gl.TEXTURE_CUBE_MAP_POSITIVE_X + face : gl.TEXTURE_2D;
      gl.texImage2D(side, level, gl.RGB8, width, height, 0, gl.RGB, gl.UNSIGNED_BYTE,
        faces[face % faces.length]);
    }
  });
  const wrap = cube ? gl.CLAMP_TO_EDGE : gl.REPEAT;
  gl.texParameteri(target, gl.TEXTURE_WRAP_S, wrap);
  gl.texParameteri(target, gl.TEXTURE_WRAP_T, wrap);
  gl.texParameteri(target, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
  gl.texParameteri(target, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
  return made;
}

/**
 * @param {WebGL2RenderingContext} gl
 * @param {number} unit
 * @param {number} target
 * @param {WebGLTexture | null} texture
 */
export function bind(gl, unit, target, texture) {
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(target, texture);
}
