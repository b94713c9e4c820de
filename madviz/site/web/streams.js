/**
 * From what cameras see to what a policy gets: failures, and the last three pictures of each stream.
 *
 *     picture (4 bytes a pixel) -> stream (colour or coded depth) -> failure -> (V x 9 x H x W)
 *
 * The rules are those of `madviz/observation`. A failure that begins now spoils one picture of the
 * three now, and all of them two decisions later. Two things differ from Python in the last bits:
 * grains of noise come from a generator of our own (from seed, step and stream, so the same episode
 * comes again), and a blur is worked out in floating point.
 */

/** @typedef {import('./messages.js').Occlusion} Occlusion */
/** @typedef {import('./messages.js').Picture} Picture */
/** @typedef {{seed: number, step: number}} Moment */

const LENGTH = 3;
const CHANNELS = 3;
/** Pixels of blur at full strength: the standard deviation. */
const BLUR = 8;

/** @param {string} stream */
export function cameraOf(stream) {
  return stream.split('.')[0];
}

/** @param {string} stream @returns {'rgb' | 'depth'} */
export function modalityOf(stream) {
  return stream.endsWith('.depth') ? 'depth' : 'rgb';
}

export class StreamStack {
  /** @param {string[]} streams */
  constructor(streams) {
    this.streams = streams;
    /** The newest LENGTH + 1 pictures of each stream; the first is what `freeze` holds on to.
     * @type {Uint8ClampedArray[][]} */
    this.arrived = streams.map(() => []);
    /** @type {Uint8ClampedArray[]} What the cameras saw last. */
    this.seen = [];
    /** @type {Moment} */
    this.moment = {seed: 0, step: 0};
    this.side = 0;
  }

  /**
   * Takes the pictures of one step; at step 0 there is no past.
   * @param {Record<string, Picture>} views By camera.
   * @param {Record<string, Occlusion>} occlusions By camera.
   * @param {Moment} moment
   */
  push(views, occlusions, moment) {
    this.moment = moment;
    this.see(views);
    this.streams.forEach((stream, i) => {
      const past = moment.step === 0 ? [] : this.arrived[i];
      const picture = this.failed(i, occlusions[cameraOf(stream)], past[past.length - 1]);
      const first = past.length === 0 ? Array(LENGTH + 1).fill(picture) : [...past, picture];
      this.arrived[i] = first.slice(-LENGTH - 1);
    });
  }

  /**
   * Lets the newest pictures arrive again, under other failures.
   * @param {Record<string, Occlusion>} occlusions
   */
  replaceLast(occlusions) {
    const first = this.moment.step === 0;
    this.streams.forEach((stream, i) => {
      const past = this.arrived[i].slice(0, -1);
      const before = first ? undefined : past[past.length - 1];
      const picture = this.failed(i, occlusions[cameraOf(stream)], before);
      this.arrived[i] = first ? Array(LENGTH + 1).fill(picture) : [...past, picture];
    });
  }

  /**
   * Exchanges what cameras saw last, as if it had always been so, and lets it arrive.
   * @param {Record<string, Picture>} views
   * @param {Record<string, Occlusion>} occlusions
   */
  replaceViews(views, occlusions) {
    this.see(views);
    this.replaceLast(occlusions);
  }

  /** @param {Record<string, Picture>} views */
  see(views) {
    this.seen = this.streams.map(stream => {
      const {rgba, width} = views[cameraOf(stream)];
      this.side = width;
      return modalityOf(stream) === 'depth' ? depthOf(rgba) : rgba;
    });
  }

  /** @returns {Record<string, Picture>} By stream, what arrived last; copies. */
  newest() {
    return Object.fromEntries(this.streams.map((stream, i) => {
      const rgba = this.arrived[i][LENGTH].slice();
      for (let p = 3; p < rgba.length; p += 4) rgba[p] = 255;
      return [stream, {width: this.side, height: this.side, rgba}];
    }));
  }

  /** @returns {Uint8Array} (V x 9 x H x W), oldest picture first. */
  views() {
    const pixels = this.side * this.side;
    const views = new Uint8Array(this.streams.length * LENGTH * CHANNELS * pixels);
    let at = 0;
    for (const pictures of this.arrived) {
      for (const rgba of pictures.slice(1)) {
        for (let channel = 0; channel < CHANNELS; channel++) {
          for (let i = 0; i < pixels; i++) views[at++] = rgba[4 * i + channel];
        }
      }
    }
    return views;
  }

  /**
   * @param {number} stream
   * @param {Occlusion | undefined} occlusion
   * @param {Uint8ClampedArray | undefined} before What arrived last.
   */
  failed(stream, occlusion, before) {
    const random = generator(this.moment, this.streams[stream]);
    return occluded(this.seen[stream], this.side, occlusion, before, random);
  }
}

/**
 * What arrives instead of a picture. Pure.
 * @param {Uint8ClampedArray} rgba
 * @param {number} side Pixels.
 * @param {Occlusion | undefined} occlusion
 * @param {Uint8ClampedArray | undefined} before
 * @param {() => number} random A whole number below 256.
 * @returns {Uint8ClampedArray}
 */
export function occluded(rgba, side, occlusion, before, random) {
  switch (occlusion?.kind ?? 'none') {
    case 'black':
      return new Uint8ClampedArray(rgba.length);
    case 'freeze':
      return before ?? rgba;
    case 'noise': {
      const {strength} = /** @type {Occlusion} */ (occlusion);
      return rgba.map((value, i) =>
        i % 4 === 3 ? value : Math.round(value * (1 - strength) + random() * strength));
    }
    case 'blur':
      return blurred(rgba, side, BLUR * /** @type {Occlusion} */ (occlusion).strength);
    case 'patch':
      return patched(rgba, side, /** @type {Occlusion} */ (occlusion));
    default:
      return rgba;
  }
}

/**
 * @param {Uint8ClampedArray} rgba
 * @param {number} side
 * @param {Occlusion} occlusion
 */
function patched(rgba, side, {strength, x, y, width, height}) {
  const result = rgba.slice();
  const [top, bottom] = covered(y, height, side);
  const [left, right] = covered(x, width, side);
  for (let row = top; row < bottom; row++) {
    for (let column = left; column < right; column++) {
      const at = 4 * (row * side + column);
      for (let c = 0; c < 3; c++) result[at + c] = Math.floor(rgba[at + c] * (1 - strength));
    }
  }
  return result;
}

/**
 * The rows, or columns, of `count` that a patch covers: the first, and the one after the last.
 * @param {number} middle
 * @param {number} share
 * @param {number} count
 */
function covered(middle, share, count) {
  return [Math.max(middle - share / 2, 0), Math.min(middle + share / 2, 1)]
    .map(edge => even(edge * count));
}

/** Rounds halves to even, as Python does. @param {number} value */
function even(value) {
  const below = Math.floor(value);
  if (value - below !== 0.5) return Math.round(value);
  return below % 2 === 0 ? below : below + 1;
}

/**
 * Gaussian, mirrored at the edges, as OpenCV's with a size of its own choice.
 * @param {Uint8ClampedArray} rgba
 * @param {number} side
 * @param {number} sigma Pixels.
 */
function blurred(rgba, side, sigma) {
  if (sigma < 0.1) return rgba;
  const reach = Math.max((even(sigma * 6 + 1) | 1) >> 1, 1);
  const weights = Array.from({length: 2 * reach + 1}, (_, i) =>
    Math.exp(-((i - reach) ** 2) / (2 * sigma * sigma)));
  const sum = weights.reduce((all, weight) => all + weight, 0);
  const kernel = weights.map(weight => weight / sum);
  const across = convolved(Float32Array.from(rgba), side, kernel, reach, 1, side);
  return Uint8ClampedArray.from(convolved(across, side, kernel, reach, side, 1));
}

/**
 * @param {Float32Array} pixels
 * @param {number} side
 * @param {number[]} kernel
 * @param {number} reach
 * @param {number} step Pixels to the neighbour along the axis.
 * @param {number} other Pixels to the next line.
 */
function convolved(pixels, side, kernel, reach, step, other) {
  const result = new Float32Array(pixels.length);
  for (let line = 0; line < side; line++) {
    for (let i = 0; i < side; i++) {
      for (let c = 0; c < 4; c++) {
        let value = 0;
        for (let k = -reach; k <= reach; k++) {
          const at = line * other + mirrored(i + k, side) * step;
          value += kernel[k + reach] * pixels[4 * at + c];
        }
        result[4 * (line * other + i * step) + c] = value;
      }
    }
  }
  return result;
}

/**
 * @param {number} index
 * @param {number} count
 */
function mirrored(index, count) {
  const period = 2 * (count - 1);
  const inside = ((index % period) + period) % period;
  return inside < count ? inside : period - inside;
}

/**
 * Coded depth as three equal numbers.
 * @param {Uint8ClampedArray} rgba
 */
function depthOf(rgba) {
  return rgba.map((_, i) => rgba[i | 3]);
}

/**
 * A generator of bytes for one stream at one step: xorshift over a hash of all three.
 * @param {Moment} moment
 * @param {string} stream
 * @returns {() => number}
 */
function generator({seed, step}, stream) {
  let state = 2166136261;
  for (const letter of `${seed} ${step} ${stream}`) {
    state = Math.imul(state ^ letter.charCodeAt(0), 16777619);
  }
  state |= 1;
  return () => {
    state ^= state << 13;
    state ^= state >>> 17;
    state ^= state << 5;
    return state >>> 24;
  };
}
