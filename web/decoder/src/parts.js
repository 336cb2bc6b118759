import { crc32, u32 } from './bytes.js';
import { decodeChunk } from './chunk.js';
import { FgsError, StreamError } from './errors.js';
import { leastBytes } from './header2.js';
import { compareCrc, truncated } from './preamble.js';
import { values2 } from './values.js';
import { decodeChunk1, values1 } from './version1.js';

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
  const { header, model, ranges } = frame;
  if (header.version === 1) {
    const codes = decodeChunk1(header, place.start, bytes, options.sh);
    const values = () => values1(codes, header, ranges, place.start, place.rows);
    return { chunk: new Chunk(place, codes, !options.open, values), used: place.bytes };
  }
  const { codes, used } = decodeChunk(model, header.low, place.rows, bytes, options);
  return { chunk: new Chunk(place, codes, !options.open, () => values2(codes, header)), used };
}

/** The checked chunk table: the length and checksum of each chunk. It lies at the end of the file. */
export function readTable(name, frame, data) {
  const { header, size } = frame;
  const offset = size - header.tableBytes;
  if (data.length !== header.tableBytes) throw truncated(name, offset, 'chunk table', header.tableBytes, data.length);
  const body = data.subarray(0, data.length - 4);
  compareCrc(name, 'chunk table', offset, u32(data, data.length - 4), crc32(body));
  const lengths = new Uint32Array(header.chunkCount);
  const sums = new Uint32Array(header.chunkCount);
  let at = header.chunksOffset;
  for (const place of frame.plan()) {
    const i = place.index;
    lengths[i] = u32(body, 8 * i);
    sums[i] = u32(body, 8 * i + 4);
    const fault = wrongLength(header, place, lengths[i]);
    if (fault) throw new FgsError(name, offset + 8 * i, `chunk ${i}: length: wanted ${fault}, got ${lengths[i]}`);
    at += lengths[i];
  }
  if (at !== offset) {
    throw new FgsError(name, offset, `chunk table: wanted chunks that end at ${offset}, got ${at}`);
  }
  return { lengths, sums };
}

function wrongLength(header, place, length) {
  if (header.version === 1) return length === place.bytes ? '' : String(place.bytes);
  const least = leastBytes(place.rows);
  return length < least || length % 2 ? `an even ${least} or more` : '';
}

/** The error of a chunk that does not decode, with its place; other errors as they are. */
export function chunkError(name, index, offset, error) {
  return error instanceof StreamError ? new FgsError(name, offset, `chunk ${index}: ${error.message}`) : error;
}
