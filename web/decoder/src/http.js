// Files on servers: by ranges where a server knows them, else as a stream.
import { StreamSource } from './incoming.js';

const FIRST = 1 << 16;
/** The table of up to 511 chunks. */
const LAST = 4096;

/** A file on a server that answers to ranges; its first and its last bytes are here. */
class HttpSource {
  #coming = null;

  constructor(url, init, size, first, last) {
    Object.assign(this, { url, init, size, first, last });
    this.lastStart = size - last.length;
  }

  async read(offset, length) {
    const end = Math.min(offset + length, this.size);
    if (end <= this.first.length) return this.first.subarray(offset, end);
    if (offset >= this.lastStart) return this.last.subarray(offset - this.lastStart, end - this.lastStart);
    const from = Math.max(offset, this.first.length);
    const to = Math.min(end, this.lastStart);
    const parts = [this.first.subarray(offset), await this.#between(from, to), this.last.subarray(0, Math.max(end - to, 0))];
    const bytes = new Uint8Array(end - offset);
    let at = 0;
    for (const part of parts) {
      bytes.set(part, at);
      at += part.length;
    }
    return bytes;
  }

  /** Let these bytes come, since they will be read one after the other. */
  ahead(start, end) {
    const [from, to] = [Math.max(start, this.first.length), Math.min(end, this.lastStart)];
    if (to <= from) return;
    const source = this.#ask(from, to).then((response) => new StreamSource(bodyOf(response)));
    // A fault is told when the bytes are read.
    source.catch(() => {});
    this.#coming = { source, from, to };
  }

  /** Stop what `ahead` began. */
  async cancel() {
    const source = this.#coming?.source;
    this.#coming = null;
    await source?.then((stream) => stream.cancel()).catch(() => {});
  }

  async #between(from, to) {
    const coming = this.#coming;
    let bytes;
    if (coming?.from === from && to <= coming.to) {
      const stream = await coming.source;
      bytes = (await stream.peek(to - from)).slice();
      stream.drop(bytes.length);
      coming.from += bytes.length;
    } else bytes = new Uint8Array(await (await this.#ask(from, to)).arrayBuffer()).subarray(0, to - from);
    if (bytes.length < to - from) throw new Error(`${this.url}: wanted ${to - from} bytes from ${from} on, got ${bytes.length}`);
    return bytes;
  }

  async #ask(from, to) {
    const response = await ask(this.url, this.init, `bytes=${from}-${to - 1}`);
    if (response.status !== 206 || sizeOf(response) !== this.size) {
      throw new Error(`${this.url}: the file changed, or the server does not answer to ranges any more`);
    }
    return response;
  }
}

/**
 * Ask for the first and the last bytes at once. A server that does not know ranges sends the whole file, which is read as a stream.
 * What comes can be given to `open`, also in a worker, which may still be starting.
 */
export async function prefetch(url, init = {}) {
  const ending = ask(url, init, `bytes=-${LAST}`).catch(() => null);
  const response = await ask(url, init, `bytes=0-${FIRST - 1}`);
  const size = sizeOf(response);
  if (response.status !== 206 || size === null) {
    ending.then((other) => other?.body?.cancel());
    return { stream: bodyOf(response) };
  }
  const first = new Uint8Array(await response.arrayBuffer());
  return { url: String(url), size, first, last: await lastOf(await ending, size) };
}

/** The source of what `prefetch` gives. */
export function prefetched({ stream, url, size, first, last }, init) {
  return stream ? new StreamSource(stream) : new HttpSource(url, init, size, first, last);
}

/** The last bytes; none if the server does not know ranges that count from the end. */
async function lastOf(response, size) {
  const range = /^bytes (\d+)-(\d+)\//.exec(response?.headers.get('Content-Range') ?? '');
  if (response?.status === 206 && range && sizeOf(response) === size && Number(range[2]) === size - 1) {
    const bytes = new Uint8Array(await response.arrayBuffer());
    if (bytes.length === size - Number(range[1])) return bytes;
  } else response?.body?.cancel();
  return new Uint8Array(0);
}

async function ask(url, init, range) {
  const headers = new Headers(init.headers);
  headers.set('Range', range);
  const response = await fetch(url, { ...init, headers });
  // 416: an empty file has no first byte.
  if (!response.ok && response.status !== 416) throw new Error(`${url}: the server says ${response.status}`);
  return response;
}

export function bodyOf(response) {
  if (!response.ok && response.status !== 416) throw new Error(`${response.url}: the server says ${response.status}`);
  return response.ok && response.body ? response.body : new Blob([]).stream();
}

function sizeOf(response) {
  const found = /^bytes \d+-\d+\/(\d+)$/.exec(response.headers.get('Content-Range') ?? '');
  return found ? Number(found[1]) : null;
}
