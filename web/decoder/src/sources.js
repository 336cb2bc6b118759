// Where bytes come from. Ranged sources give any part of a file; streamed ones give all bytes once.
import { bodyOf, prefetch, prefetched } from './http.js';
import { StreamSource } from './incoming.js';
import { MemorySource } from './memory.js';

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

const inNode = typeof globalThis.process?.versions?.node === 'string';

/**
 * The source of what a caller gives: bytes, a blob, a stream, a response, an address (in Node also a path or a stream of
 * its own), or an object with `size` and `read`.
 * @returns {Promise<MemorySource | BlobSource | HttpSource | StreamSource | {size: number, read: Function}>}
 */
export async function toSource(given, init = {}) {
  if (given instanceof ArrayBuffer) return new MemorySource(new Uint8Array(given));
  if (ArrayBuffer.isView(given)) {
    return new MemorySource(new Uint8Array(given.buffer, given.byteOffset, given.byteLength));
  }
  if (typeof Blob !== 'undefined' && given instanceof Blob) return new BlobSource(given);
  if (inNode) {
    const node = await import('#node');
    const address = typeof given === 'string' || given instanceof URL;
    if (address && node.isPath(given)) return node.PathSource.of(given);
    if (typeof given?.pipe === 'function') return node.streamSource(given);
  }
  if (typeof given === 'string' || given instanceof URL) return prefetched(await prefetch(given, init), init);
  if (typeof Response !== 'undefined' && given instanceof Response) return new StreamSource(bodyOf(given));
  if (typeof given?.getReader === 'function') return new StreamSource(given);
  if (typeof given?.read === 'function' && Number.isSafeInteger(given.size)) return given;
  if (given?.stream?.getReader || ArrayBuffer.isView(given?.first)) return prefetched(given, init);
  throw new TypeError('wanted bytes, a Blob, a ReadableStream, a Response, an address, or an object with size and read');
}
