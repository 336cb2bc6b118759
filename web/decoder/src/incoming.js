/**
 * Bytes as they come. `size` is null until the end was seen.
 */
export class StreamSource {
  constructor(stream) {
    this.reader = stream.getReader();
    this.held = new Uint8Array(0);
    this.length = 0;
    this.position = 0;
    this.ended = false;
  }

  /** Wait until `count` bytes are here, or the stream's end; returns those that are here, at most `count`. */
  async peek(count) {
    while (this.length < count && !this.ended) {
      const { value, done } = await this.reader.read();
      if (done) this.ended = true;
      else this.#add(value);
    }
    return this.held.subarray(0, Math.min(count, this.length));
  }

  /** Bytes that can be had without waiting. */
  get here() {
    return this.length;
  }

  /** Pass over bytes that were peeked at. */
  drop(count) {
    this.held.copyWithin(0, count, this.length);
    this.length -= count;
    this.position += count;
  }

  async cancel() {
    await this.reader.cancel().catch(() => {});
  }

  #add(bytes) {
    const wanted = this.length + bytes.length;
    if (wanted > this.held.length) {
      const grown = new Uint8Array(Math.max(wanted, 2 * this.held.length));
      grown.set(this.held.subarray(0, this.length));
      this.held = grown;
    }
    this.held.set(bytes, this.length);
    this.length = wanted;
  }
}
