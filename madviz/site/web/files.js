/**
 * Fetches the site's files. They are gzipped on the disk and unpacked here, so that any static host
 * serves this weight. One that calls them encoded (`Content-Encoding: gzip`) has the browser unpack
 * them: then they come as they are, which their first two bytes tell.
 */

/** @typedef {import('./messages.js').SiteFile} SiteFile */
/** @typedef {(bytes: number) => void} OnBytes */

/**
 * @param {string} base Address of the site's folder, ends with a slash.
 * @returns {Promise<import('./messages.js').Manifest>}
 */
export async function fetchManifest(base) {
  const response = await get(new URL('manifest.json', base).href);
  const manifest = await response.json();
  if (manifest.schema !== 1)
    throw new Error('manifest.json: expected schema 1; make the site again');
  return manifest;
}

/**
 * The unpacked bytes of a file. Throws an Error in one sentence for one that is missing, cut off,
 * or outside the site.
 * @param {string} base
 * @param {SiteFile} file
 * @param {OnBytes} [onBytes] Called with the bytes of each piece as they come over the wire.
 * @returns {Promise<ArrayBuffer>}
 */
export async function fetchGzip(base, file, onBytes = () => {}) {
  const address = new URL(file.path, base).href;
  if (!address.startsWith(base)) throw new Error(`${file.path}: expected a file of this site`);
  const response = await get(address);
  if (!response.body) throw new Error(`${file.path}: expected bytes, found none`);
  const counted = response.body.pipeThrough(
    new TransformStream({
      transform(piece, controller) {
        onBytes(piece.byteLength);
        controller.enqueue(piece);
      },
    }),
  );
  try {
    const come = await new Response(counted).arrayBuffer();
    const buffer = isGzip(come, file) ? await unpacked(come) : come;
    if (buffer.byteLength !== file.unpacked) throw new Error('another size');
    return buffer;
  } catch (error) {
    throw new Error(`${file.path}: the file is cut off or damaged; load the page again`);
  }
}

/** @param {ArrayBuffer} come @param {SiteFile} file */
function isGzip(come, file) {
  const [first, second] = new Uint8Array(come);
  return first === 0x1f && second === 0x8b && come.byteLength !== file.unpacked;
}

/** @param {ArrayBuffer} packed */
function unpacked(packed) {
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream('gzip'));
  return new Response(stream).arrayBuffer();
}

/** @param {string} address */
async function get(address) {
  let response;
  try {
    response = await fetch(address);
  } catch (error) {
    throw new Error(`${address}: it could not be fetched; are you connected?`);
  }
  if (!response.ok) throw new Error(`${address}: expected a file, found ${response.status}`);
  return response;
}

/**
 * Imports a module whose source is gzipped. It must not import others by relative names.
 * @param {ArrayBuffer} source
 */
export async function importSource(source) {
  const address = URL.createObjectURL(new Blob([source], {type: 'text/javascript'}));
  try {
    return await import(address);
  } finally {
    URL.revokeObjectURL(address);
  }
}
