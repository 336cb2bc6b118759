// Where bytes come from. Ranged sources give any part of a file; streamed ones give all bytes once.

const PIECE = 1 << 16;

/** A whole file in memory. */
export class MemorySource {
  constructor(bytes) {
    this.bytes = bytes;
    this.size = bytes.length;
  }

  async read(offset, length) {
    return this.bytes.subarray(offset, offset + length);
  }
}

/** A `Blob` or a `File`, which is read part by part. */
export class BlobSource {
  constructor(blob) {
    this.blob = blob;
    this.size = blob.size;
  }

  async read(offset, length) {
    return new Uint8Array(await this.blob.slice(offset, offset + length).arrayBuffer());
  }
}

/** A file on a server that answers to ranges; the first answer has the first bytes. */
export class HttpSource {
  constructor(url, init, size, first) {
    Object.assign(this, { url, init, size, first });
  }

  async read(offset, length) {
    const end = Math.min(offset + length, this.size);
    if (end <= this.first.length) return this.first.subarray(offset, end);
    if (end <= offset) return new Uint8Array(0);
    const response = await ask(this.url, this.init, `bytes=${offset}-${end - 1}`);
    if (response.status !== 206 || sizeOf(response) !== this.size) {
      throw new Error(`${this.url}: the file changed, or the server does not answer to ranges any more`);
    }
    const bytes = new Uint8Array(await response.arrayBuffer());
    return bytes.subarray(0, end - offset);
  }
}

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

/**
 * The source of what a caller gives: bytes, a blob, a stream, a response, an address, or an object with `size` and `read`.
 * @returns {Promise<MemorySource | BlobSource | HttpSource | StreamSource | {size: number, read: Function}>}
 */
export async function toSource(given, init = {}) {
  if (given instanceof ArrayBuffer) return new MemorySource(new Uint8Array(given));
  if (ArrayBuffer.isView(given)) {
    return new MemorySource(new Uint8Array(given.buffer, given.byteOffset, given.byteLength));
  }
  if (typeof Blob !== 'undefined' && given instanceof Blob) return new BlobSource(given);
  if (typeof given === 'string' || given instanceof URL) return openUrl(String(given), init);
  if (typeof Response !== 'undefined' && given instanceof Response) return new StreamSource(bodyOf(given));
  if (typeof given?.getReader === 'function') return new StreamSource(given);
  if (typeof given?.read === 'function' && Number.isSafeInteger(given.size)) return given;
  throw new TypeError('wanted bytes, a Blob, a ReadableStream, a Response, an address, or an object with size and read');
}

/** Ask for the first bytes. A server that does not know ranges sends the whole file, which is read as a stream. */
async function openUrl(url, init) {
  const response = await ask(url, init, `bytes=0-${PIECE - 1}`);
  const size = sizeOf(response);
  if (response.status !== 206 || size === null) return new StreamSource(bodyOf(response));
  return new HttpSource(url, init, size, new Uint8Array(await response.arrayBuffer()));
}

async function ask(url, init, range) {
  const headers = new Headers(init.headers);
  headers.set('Range', range);
  const response = await fetch(url, { ...init, headers });
  // 416: an empty file has no first byte.
  if (!response.ok && response.status !== 416) throw new Error(`${url}: the server says ${response.status}`);
  return response;
}

function bodyOf(response) {
  if (!response.ok && response.status !== 416) throw new Error(`${response.url}: the server says ${response.status}`);
  return response.ok && response.body ? response.body : new Blob([]).stream();
}

function sizeOf(response) {
  const found = /^bytes \d+-\d+\/(\d+)$/.exec(response.headers.get('Content-Range') ?? '');
  return found ? Number(found[1]) : null;
}
