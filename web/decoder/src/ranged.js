import { FgsFile } from './file.js';
import { readFrame, readHeader, sharedPart } from './frame.js';
import { PREAMBLE_BYTES } from './limits.js';
import { checkedChunk, readTable } from './parts.js';
import { readPreamble } from './preamble.js';

/** Open a file of which any part can be had. */
export async function openRanged(source, name) {
  const preamble = readPreamble(name, await source.read(0, PREAMBLE_BYTES), source.size);
  const header = readHeader(name, await source.read(PREAMBLE_BYTES, preamble.headerBytes), preamble);
  const { offset, length } = sharedPart(header);
  const frame = readFrame(name, header, preamble.size, await source.read(offset, length));
  return new RangedFile(source, name, frame);
}

/** A file of which any chunk can be had. Each chunk is checked before it is decoded. */
class RangedFile extends FgsFile {
  #source;
  #name;
  #frame;
  #parts = null;

  constructor(source, name, frame) {
    const { chunksOffset, previewBytes = 0 } = frame.header;
    super(
      frame,
      (options) => this.#inOrder(options),
      () => source.read(chunksOffset - previewBytes, previewBytes),
    );
    this.#source = source;
    this.#name = name;
    this.#frame = frame;
  }

  async chunk(index, { sh = true } = {}) {
    const parts = await this.#places();
    if (!(index in parts)) throw new RangeError(`wanted a chunk from 0 to ${parts.length - 1}, got ${index}`);
    return this.#decoded(parts[index], sh);
  }

  async *#inOrder({ sh, layers, first }) {
    const parts = (await this.#places()).slice(first).filter(({ place }) => place.layer < layers);
    const last = parts.at(-1);
    if (last) this.#source.ahead?.(parts[0].offset, last.offset + last.length);
    try {
      for (const part of parts) yield await this.#decoded(part, sh);
    } finally {
      await this.#source.cancel?.();
    }
  }

  async #decoded({ place, offset, length, sum }, sh) {
    const bytes = await this.#source.read(offset, length);
    return checkedChunk(this.#name, this.#frame, place, offset, length, sum, bytes, sh);
  }

  /** Where each chunk lies, by the table at the end. */
  #places() {
    this.#parts ??= this.#readPlaces().catch((error) => {
      this.#parts = null;
      throw error;
    });
    return this.#parts;
  }

  async #readPlaces() {
    const { header, size, format } = this.#frame;
    const table = await this.#source.read(size - header.tableBytes, header.tableBytes);
    const { lengths, sums } = readTable(this.#name, this.#frame, table);
    let offset = header.chunksOffset;
    return Array.from(format.planChunks(header), (place) => {
      const part = { place, offset, length: lengths[place.index], sum: sums[place.index] };
      offset += part.length;
      return part;
    });
  }
}
