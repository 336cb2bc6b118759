// What only Node has: files by their path, and its streams.
import { open } from 'node:fs/promises';
import { Readable } from 'node:stream';
import { StreamSource } from './incoming.js';

/** Whether an address names a file: a path, or a `file:` address. Other schemes have two letters or more. */
export function isPath(given) {
  return given instanceof URL ? given.protocol === 'file:' : /^file:/i.test(given) || !/^[a-z][a-z0-9+.-]+:/i.test(given);
}

/** A file, which is read part by part. It is opened for each part, so that nobody has to close it. */
export class PathSource {
  static async of(given) {
    const path = typeof given === 'string' && /^file:/i.test(given) ? new URL(given) : given;
    const source = new PathSource();
    source.path = path;
    source.size = await source.#with(async (file) => (await file.stat()).size);
    return source;
  }

  async read(offset, length) {
    return this.#with(async (file) => {
      const part = new Uint8Array(length);
      let done = 0;
      while (done < length) {
        const { bytesRead } = await file.read(part, done, length - done, offset + done);
        if (!bytesRead) break;
        done += bytesRead;
      }
      return part.subarray(0, done);
    });
  }

  async #with(use) {
    const file = await open(this.path);
    try {
      return await use(file);
    } finally {
      await file.close();
    }
  }
}

export function streamSource(readable) {
  return new StreamSource(Readable.toWeb(readable));
}
