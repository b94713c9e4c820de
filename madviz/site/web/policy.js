/**
 * Runs a policy's graph with ONNX Runtime in WebAssembly, on one thread.
 *
 * The graph encodes every stream and reads any number of subsets: one row of `masks` for each. One
 * row takes 3 to 7 ms for three streams, all eight 16 to 27 ms, so the others are read less often.
 */
import {importSource} from './files.js';

/** @typedef {any} Runtime The module of `onnxruntime-web`. */
/** @typedef {import('./messages.js').SitePolicy} SitePolicy */
/**
 * What a policy makes of one moment: V streams, N subsets, Z numbers in a feature, A in an action.
 * @typedef {object} Reading
 * @property {Float32Array} features (V x Z)
 * @property {Float32Array} merged (N x Z)
 * @property {Float32Array} action (N x A)
 * @property {Float32Array} q (N)
 */

/**
 * @param {Record<'ort.js' | 'ort_glue.js' | 'ort.wasm', ArrayBuffer>} files
 * @returns {Promise<Runtime>}
 */
export async function startRuntime(files) {
  const runtime = await importSource(files['ort.js']);
  const glue = URL.createObjectURL(new Blob([files['ort_glue.js']], {type: 'text/javascript'}));
  runtime.env.wasm.numThreads = 1;
  runtime.env.wasm.proxy = false;
  runtime.env.wasm.wasmPaths = {mjs: glue};
  runtime.env.wasm.wasmBinary = files['ort.wasm'];
  return runtime;
}

export class Policy {
  /**
   * @param {Runtime} runtime
   * @param {SitePolicy} spec
   * @param {any} session
   * @param {import('./guard.js').GuardValues | null} guard
   */
  constructor(runtime, spec, session, guard) {
    this.runtime = runtime;
    this.spec = spec;
    this.session = session;
    this.guard = guard;
  }

  /**
   * @param {Runtime} runtime
   * @param {SitePolicy} spec
   * @param {ArrayBuffer} graph
   * @param {ArrayBuffer} [guard]
   */
  static async load(runtime, spec, graph, guard) {
    const options = {executionProviders: ['wasm'], graphOptimizationLevel: 'all'};
    const session = await runtime.InferenceSession.create(new Uint8Array(graph), options);
    const values = guard ? JSON.parse(new TextDecoder().decode(guard)) : null;
    return new Policy(runtime, spec, session, values);
  }

  /**
   * @param {Uint8Array} views (V x 9 x H x W)
   * @param {Float32Array} state (S)
   * @param {boolean[][]} masks (N x V): which streams are present.
   * @returns {Promise<Reading>}
   */
  async read(views, state, masks) {
    const {Tensor} = this.runtime;
    const streams = this.spec.streams.length;
    const side = Math.sqrt(views.length / streams / 9);
    const rows = Float32Array.from(masks.flat(), Number);
    const found = await this.session.run({
      views: new Tensor('uint8', views, [streams, 9, side, side]),
      state: new Tensor('float32', state, [1, state.length]),
      masks: new Tensor('float32', rows, [masks.length, streams]),
    });
    const {features, merged, action, q} = found;
    return {features: features.data, merged: merged.data, action: action.data, q: q.data};
  }
}
