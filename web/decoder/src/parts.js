import { crc32, u32 } from './bytes.js';
import { FgsError, StreamError } from './errors.js';
import { compareCrc, truncated } from './preamble.js';

/** A decoded chunk. */
export class Chunk {
  #values;

  constructor(place, codes, verified, values) {
    this.index = place.index;
    this.layer = place.layer;
    this.start = place.start;
    this.rows = place.rows;
    this.codes = codes;
    /** Whether its checksum was compared; while a stream comes in, checksums are not there yet. */
    this.verified = verified;
    this.#values = values;
  }

  /** Planes of values, one after the other: binary32, the same bits as in the program. */
  values() {
    return this.#values();
  }
}

/**
 * Decode a chunk.
 * @returns {{chunk: Chunk, used: number}} and its bytes
 */
export function decodePlace(frame, place, bytes, options) {
  const { codes, used, values } = frame.format.decode(frame, place, bytes, options);
  return { chunk: new Chunk(place, codes, !options.open, values), used };
}

/** Check a chunk and decode it. */
export function checkedChunk(name, frame, place, offset, length, sum, bytes, sh) {
  const part = `chunk ${place.index}`;
  if (bytes.length !== length) throw truncated(name, offset, part, length, bytes.length);
  compareCrc(name, part, offset, sum, crc32(bytes));
  try {
    return decodePlace(frame, place, bytes, { sh }).chunk;
  } catch (error) {
    throw chunkError(name, place.index, offset, error);
  }
}

/** The checked chunk table: the length and checksum of each chunk. It lies at the end of the file. */
export function readTable(name, frame, data) {
  const { header, size, format } = frame;
  const offset = size - header.tableBytes;
  if (data.length !== header.tableBytes) throw truncated(name, offset, 'chunk table', header.tableBytes, data.length);
  const body = data.subarray(0, data.length - 4);
  compareCrc(name, 'chunk table', offset, u32(data, data.length - 4), crc32(body));
  const lengths = new Uint32Array(header.chunkCount);
  const sums = new Uint32Array(header.chunkCount);
  let at = header.chunksOffset;
  for (const place of format.planChunks(header)) {
    const i = place.index;
    lengths[i] = u32(body, 8 * i);
    sums[i] = u32(body, 8 * i + 4);
    const fault = format.wrongLength(place, lengths[i]);
    if (fault) throw new FgsError(name, offset + 8 * i, `chunk ${i}: length: wanted ${fault}, got ${lengths[i]}`);
    at += lengths[i];
  }
  if (at !== offset) {
    throw new FgsError(name, offset, `chunk table: wanted chunks that end at ${offset}, got ${at}`);
  }
  return { lengths, sums };
}

/** The error of a chunk that does not decode, with its place; other errors as they are. */
export function chunkError(name, index, offset, error) {
  return error instanceof StreamError ? new FgsError(name, offset, `chunk ${index}: ${error.message}`) : error;
}
