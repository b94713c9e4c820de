/**
 * A task's scene as `madviz/site/drawn_scene.py` wrote it: what is drawn, without OpenGL.
 */
import {readTensors} from './tensors.js';

/**
 * @typedef {object} Shape
 * @property {number} [body] In whose frame it stands; -1 is the sky.
 * @property {number} [site] Or in whose site's frame.
 * @property {number[]} position In that frame, metres.
 * @property {number[]} rotation Nine numbers, row by row.
 * @property {number[]} rgba
 * @property {number} emission
 * @property {number} specular
 * @property {number} shininess
 * @property {number} radius Of the ball about it, metres.
 * @property {boolean} plane
 * @property {number | null} texture
 * @property {number[]} texture_scale
 * @property {number[]} texture_shift
 * @property {number[]} low Where its corners begin, metres.
 * @property {number[]} span
 * @property {[number, number]} corners First, count.
 * @property {[number, number]} triangles
 */

/**
 * @typedef {object} Light
 * @property {boolean} headlight It shines from the camera.
 * @property {number[]} direction
 * @property {number[]} ambient
 * @property {number[]} diffuse
 * @property {number[]} specular
 */

/** @typedef {{cube: boolean, levels: {width: number, height: number, faces: Uint8Array[]}[]}} Texture */

/**
 * @typedef {object} Scene
 * @property {Shape[]} shapes
 * @property {Light[]} lights
 * @property {number} near
 * @property {number} far
 * @property {Texture[]} textures
 * @property {Float32Array} positions Three numbers for each corner, metres.
 * @property {Float32Array} normals
 * @property {Float32Array} numbers Of the shape of each corner.
 * @property {Uint16Array} triangles Three corners for each.
 */

/**
 * @param {ArrayBuffer} buffer The scene's file, unpacked.
 * @param {ArrayBuffer[]} textures Its textures' files, in the task's order.
 * @returns {Scene}
 */
export function parseScene(buffer, textures) {
  const {tensors, metadata} = readTensors(buffer);
  const said = JSON.parse(metadata.scene);
  const count = tensors.positions.shape[0];
  const positions = new Float32Array(3 * count);
  const numbers = new Float32Array(count);
  said.shapes.forEach((/** @type {Shape} */ shape, /** @type {number} */ number) => {
    const [first, corners] = shape.corners;
    for (let i = 3 * first; i < 3 * (first + corners); i++) {
      const axis = i % 3;
      positions[i] = shape.low[axis] + shape.span[axis] * tensors.positions.data[i] / 65535;
    }
    numbers.fill(number, first, first + corners);
  });
  return {
    shapes: said.shapes,
    lights: said.lights,
    near: said.near,
    far: said.far,
    textures: textures.map((file, i) => parseTexture(file, said.cubes[i])),
    positions,
    normals: Float32Array.from(tensors.normals.data, value => value / 32767),
    numbers,
    triangles: /** @type {Uint16Array} */ (tensors.triangles.data),
  };
}

/**
 * Rows are stored as differences to the left neighbour, which packs better.
 * @param {ArrayBuffer} file
 * @param {boolean} cube
 * @returns {Texture}
 */
function parseTexture(file, cube) {
  const {tensors} = readTensors(file);
  const levels = Object.keys(tensors).map((_, i) => {
    const {shape, data} = tensors[`level${i}`];
    const [faces, height, width] = shape;
    const pixels = /** @type {Uint8Array} */ (data);
    for (let i = 0; i < pixels.length; i++) {
      if (i % (3 * width) >= 3) pixels[i] += pixels[i - 3];
    }
    const size = 3 * width * height;
    const parts = Array.from({length: faces}, (_, face) =>
      pixels.subarray(face * size, (face + 1) * size));
    return {width, height, faces: parts};
  });
  return {cube, levels};
}

/**
 * Where every shape is: position and nine numbers of rotation each, in the scene's order.
 * @param {Scene} scene
 * @param {{xpos: Float64Array, xmat: Float64Array, site_xpos: Float64Array, site_xmat: Float64Array}} data
 * @returns {Float32Array} (G x 12)
 */
export function shapePoses(scene, data) {
  const poses = new Float32Array(12 * scene.shapes.length);
  scene.shapes.forEach((shape, number) => {
    const pose = poses.subarray(12 * number, 12 * number + 12);
    if (shape.body === -1) return;
    const ofSite = shape.site !== undefined;
    const frame = shape.site ?? shape.body ?? 0;
    const place = (ofSite ? data.site_xpos : data.xpos).subarray(3 * frame, 3 * frame + 3);
    const turn = (ofSite ? data.site_xmat : data.xmat).subarray(9 * frame, 9 * frame + 9);
    for (let row = 0; row < 3; row++) {
      pose[row] = place[row];
      for (let k = 0; k < 3; k++) {
        pose[row] += turn[3 * row + k] * shape.position[k];
        for (let column = 0; column < 3; column++) {
          pose[3 + 3 * row + column] += turn[3 * row + k] * shape.rotation[3 * k + column];
        }
      }
    }
  });
  return poses;
}
