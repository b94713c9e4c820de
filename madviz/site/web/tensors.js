/**
 * Reads safetensors files: eight bytes with the length of a JSON header, the header, the numbers.
 * Python writes them with the `safetensors` package.
 */

/** @typedef {Float64Array | Float32Array | Int32Array | Int16Array | Uint16Array | Uint8Array} Numbers */
/** @typedef {{shape: number[], data: Numbers}} Tensor */
/** @typedef {{tensors: Record<string, Tensor>, metadata: Record<string, string>}} TensorFile */

const KINDS = {
  F64: Float64Array,
  F32: Float32Array,
  I32: Int32Array,
  I16: Int16Array,
  U16: Uint16Array,
  U8: Uint8Array,
};

/**
 * The tensors of a file. Throws an Error that says what is wrong with it.
 * @param {ArrayBuffer} buffer
 * @returns {TensorFile}
 */
export function readTensors(buffer) {
  const length = buffer.byteLength >= 8 ? Number(new DataView(buffer).getBigUint64(0, true)) : NaN;
  if (!(length <= buffer.byteLength - 8)) throw new Error('the file is too short');
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 8, length)));
  /** @type {Record<string, Tensor>} */
  const tensors = {};
  for (const [name, {dtype, shape, data_offsets}] of Object.entries(header)) {
    if (name === '__metadata__') continue;
    const Kind = KINDS[/** @type {keyof typeof KINDS} */ (dtype)];
    const [from, to] = data_offsets;
    if (!Kind || 8 + length + to > buffer.byteLength) throw new Error('the file is too short');
    // A copy, since numbers in a file need not begin where a typed array may.
    const bytes = buffer.slice(8 + length + from, 8 + length + to);
    tensors[name] = {shape, data: new Kind(bytes)};
  }
  return {tensors, metadata: header.__metadata__ ?? {}};
}

/**
 * Row `row` of a tensor whose first axis counts rows.
 * @param {Tensor} tensor
 * @param {number} row
 */
export function rowOf(tensor, row) {
  const width = tensor.shape.slice(1).reduce((product, size) => product * size, 1);
  return tensor.data.subarray(row * width, (row + 1) * width);
}
