import { crc32, u32 } from './bytes.js';
import { FgsError, HeaderError, StreamError } from './errors.js';
import { decodeHeader2, planChunks2, wrongSize2 } from './header2.js';
import { StreamSource } from './incoming.js';
import { MAGIC, PREAMBLE_BYTES } from './limits.js';
import { readModel } from './model.js';
import { compareCrc, readPreamble, truncated } from './preamble.js';
import { rangedChunks } from './ranged.js';
import { toSource } from './sources.js';
import { streamedChunks } from './streamed.js';
import { decodeHeader1, planChunks1, readRanges, wrongSize1 } from './version1.js';

export { FgsError } from './errors.js';
export { prefetch } from './http.js';

/**
 * Open a `.fgs` file of version 1 or 2: read and check its header and its model. See `index.d.ts`.
 */
export async function open(given, options = {}) {
  const name = options.name ?? '';
  const source = await toSource(given, options.fetch);
  const streamed = source instanceof StreamSource;
  try {
    const frame = streamed ? await streamedFrame(source, name) : await rangedFrame(source, name);
    return new FgsFile(name, source, streamed, frame);
  } catch (error) {
    if (streamed) await source.cancel();
    throw error;
  }
}

/** Whether bytes begin like a `.fgs` file of any version. */
export function looksLikeFgs(bytes) {
  return MAGIC.every((byte, i) => byte === bytes[i]);
}

/** An opened file: what its header says, and its chunks. */
export class FgsFile {
  #name;
  #source;
  #streamed;
  #frame;
  #used = false;

  constructor(name, source, streamed, frame) {
    this.#name = name;
    this.#source = source;
    this.#streamed = streamed;
    this.#frame = frame;
    const { header, size } = frame;
    this.version = header.version;
    this.size = size;
    this.count = header.count;
    this.shDegree = header.shDegree;
    this.origin = header.origin;
    this.settings = header.settings;
    this.layers = header.layers;
    this.chunkCount = header.chunkCount;
    this.header = header;
  }

  /** Decode chunk after chunk. */
  async *chunks({ sh = true, layers = Infinity, first = 0 } = {}) {
    if (this.#streamed && this.#used) throw new Error('a stream can be read once: open the file again');
    this.#used = true;
    const decode = this.#streamed ? streamedChunks : rangedChunks;
    yield* decode(this.#source, this.#name, this.#frame, { sh, layers, first });
  }

  /** Stop reading. */
  async close() {
    if (this.#streamed) await this.#source.cancel();
  }
}

const HEADERS = {
  1: { decode: decodeHeader1, wrongSize: wrongSize1, plan: planChunks1 },
  2: { decode: decodeHeader2, wrongSize: wrongSize2, plan: planChunks2 },
};

async function rangedFrame(source, name) {
  const preamble = readPreamble(name, await source.read(0, PREAMBLE_BYTES), source.size);
  const block = await source.read(PREAMBLE_BYTES, preamble.headerBytes);
  const header = readHeader(name, block, preamble);
  const { part, offset, length } = sharedPart(header);
  const data = await source.read(offset, length);
  return { header, size: preamble.size, ...readShared(name, header, part, offset, length, data) };
}

async function streamedFrame(source, name) {
  // The file's true size is known at the end of the stream only; until then we trust no more than has arrived.
  const preamble = readPreamble(name, (await source.peek(PREAMBLE_BYTES)).slice(), null);
  source.drop(PREAMBLE_BYTES);
  const header = readHeader(name, (await source.peek(preamble.headerBytes)).slice(), preamble);
  source.drop(preamble.headerBytes);
  const { part, offset, length } = sharedPart(header);
  const shared = readShared(name, header, part, offset, length, await source.peek(length));
  source.drop(length);
  return { header, size: preamble.size, ...shared };
}

function readHeader(name, block, preamble) {
  const { version, size, headerBytes, headerCrc } = preamble;
  if (block.length !== headerBytes) throw truncated(name, PREAMBLE_BYTES, 'header', headerBytes, block.length);
  compareCrc(name, 'header', PREAMBLE_BYTES, headerCrc, crc32(block));
  const { decode, wrongSize } = HEADERS[version];
  try {
    const header = decode(block);
    const fault = wrongSize(header, size);
    if (fault) throw new HeaderError(`${fault} bytes, got ${size}`);
    return header;
  } catch (error) {
    if (error instanceof HeaderError) throw new FgsError(name, PREAMBLE_BYTES, `header: ${error.message}`);
    throw error;
  }
}

/** What all chunks need: the model, in version 1 the ranges. */
function sharedPart(header) {
  return header.version === 2
    ? { part: 'model', offset: header.modelOffset, length: header.modelBytes + 4 }
    : { part: 'ranges', offset: header.rangesOffset, length: header.rangesBytes };
}

function readShared(name, header, part, offset, length, data) {
  if (data.length !== length) throw truncated(name, offset, part, length, data.length);
  const body = data.subarray(0, length - 4);
  compareCrc(name, part, offset, u32(data, length - 4), crc32(body));
  const plan = () => HEADERS[header.version].plan(header);
  if (header.version === 1) return { plan, ranges: readRanges(name, body, header) };
  try {
    return { plan, model: readModel(body, header) };
  } catch (error) {
    if (error instanceof StreamError) throw new FgsError(name, offset, `model: ${error.message}`);
    throw error;
  }
}
