// Where bytes come from. Ranged sources give any part of a file; streamed ones give all bytes once.
import { bodyOf, prefetched } from './http.js';
import { StreamSource } from './incoming.js';
import { webSource } from './web-sources.js';

const inNode = typeof globalThis.process?.versions?.node === 'string';

/**
 * The source of what a caller gives: bytes, a blob, a stream, a response, an address (in Node also a path or a stream of
 * its own), or an object with `size` and `read`.
 * @returns {Promise<MemorySource | BlobSource | HttpSource | StreamSource | {size: number, read: Function}>}
 */
export async function toSource(given, init = {}) {
  const isAddress = typeof given === 'string' || given instanceof URL;
  if (inNode && (isAddress || typeof given?.pipe === 'function')) {
    const node = await import('#node');
    if (!isAddress) return node.streamSource(given);
    if (node.isPath(given)) return node.PathSource.of(given);
  }
  const source = await webSource(given, init);
  if (source) return source;
  if (typeof Response !== 'undefined' && given instanceof Response) return new StreamSource(bodyOf(given));
  if (typeof given?.getReader === 'function') return new StreamSource(given);
  if (typeof given?.read === 'function' && Number.isSafeInteger(given.size)) return given;
  if (given?.stream?.getReader || ArrayBuffer.isView(given?.first)) return prefetched(given, init);
  throw new TypeError('wanted bytes, a Blob, a ReadableStream, a Response, an address, or an object with size and read');
}
