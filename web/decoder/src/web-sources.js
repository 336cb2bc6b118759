// Sources that pages have: bytes, blobs and addresses.
import { prefetch, prefetched } from './http.js';
import { MemorySource } from './memory.js';

/** A `Blob` or a `File`, which is read part by part. */
class BlobSource {
  constructor(blob) {
    this.blob = blob;
    this.size = blob.size;
  }

  async read(offset, length) {
    return new Uint8Array(await this.blob.slice(offset, offset + length).arrayBuffer());
  }
}

/** The source of bytes, of a blob or of an address; null for anything else. */
export async function webSource(given, init = {}) {
  if (given instanceof ArrayBuffer) return new MemorySource(new Uint8Array(given));
  if (ArrayBuffer.isView(given)) {
    return new MemorySource(new Uint8Array(given.buffer, given.byteOffset, given.byteLength));
  }
  if (typeof Blob !== 'undefined' && given instanceof Blob) return new BlobSource(given);
  if (typeof given === 'string' || given instanceof URL) return prefetched(await prefetch(given, init), init);
  return null;
}
