/** An opened file: what its header says, and its chunks. See `index.d.ts`. */
export class FgsFile {
  #decode;
  #close;

  /**
   * @param {{header: object, size: number}} frame
   * @param {(options: object) => AsyncIterable<object>} decode gives the chunks
   * @param {() => Promise<Uint8Array>} previewBytes
   * @param {() => Promise<void>} [close]
   */
  constructor({ header, size }, decode, previewBytes, close = async () => {}) {
    this.previewBytes = previewBytes;
    this.#decode = decode;
    this.#close = close;
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
    yield* this.#decode({ sh, layers, first });
  }

  /** Stop reading. */
  async close() {
    await this.#close();
  }
}
