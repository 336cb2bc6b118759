import { FgsError } from '../../decoder/src/errors.js';
import { packChunk } from './pack.js';

/** What the page is told of an opened file. */
export function headerOf({ count, shDegree, origin, settings, layers, size, version, header }) {
  const shRows = header.channels ? (header.channels.rows[0] ?? 0) : (header.shCount ?? (shDegree ? count : 0));
  const { cutFrom, chunkRows, steps } = header;
  return { count, shDegree, origin, settings, layers, size, version, shRows, cutFrom, chunkRows, steps };
}

/**
 * Pack a chunk for the textures, and send it.
 *
 * @param {number} start where its rows go
 * @param {number} shStart where its rows with SH go
 * @param {number} shEnd where they have to end
 */
export function sendChunk(chunk, degree, start, shStart, shEnd) {
  const packed = packChunk(chunk.values(), chunk.rows, degree, shStart, chunk.codes.degrees);
  // The header's count of them is not checked by a decoder, and our room was made for it.
  if (shStart + packed.shRows > shEnd) throw new Error('More splats have SH than the header says.');
  const { data, sh, means, importance } = packed;
  const place = { index: chunk.index, start, rows: chunk.rows, shStart };
  self.postMessage({ chunk: { ...packed, ...place } }, [data.buffer, sh.buffer, means.buffer, importance.buffer]);
  return packed.shRows;
}

/** Send the chunks of a preview; its rows begin at `start`, those with SH at `shStart`. `degree` is that of the scene. */
export async function sendPreview(preview, degree, start, shStart) {
  const shEnd = shStart + headerOf(preview).shRows;
  let shBefore = shStart;
  for await (const chunk of preview.chunks()) shBefore += sendChunk(chunk, degree, start + chunk.start, shBefore, shEnd);
}

/** Send chunk after chunk. */
export async function sendAll(file) {
  const { shRows } = headerOf(file);
  let shBefore = 0;
  for await (const chunk of file.chunks()) shBefore += sendChunk(chunk, file.shDegree, chunk.start, shBefore, shRows);
  self.postMessage({ done: true });
}

export function sendError(error) {
  const advice = error instanceof FgsError ? '' : 'Cannot load the scene: ';
  self.postMessage({ error: advice + error.message });
}
