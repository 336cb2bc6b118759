import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { test } from 'node:test';
import { readAll, streamOf } from './read.mjs';

const FOLDER = new URL('vectors/', import.meta.url);
const VECTORS = JSON.parse(readFileSync(new URL('vectors.json', FOLDER), 'utf8'));

for (const [name, wanted] of Object.entries(VECTORS)) {
  const bytes = new Uint8Array(readFileSync(new URL(name, FOLDER)));
  const ways = {
    bytes: () => bytes,
    'bytes at an odd address': () => {
      const room = new Uint8Array(bytes.length + 3);
      room.set(bytes, 3);
      return room.subarray(3);
    },
    'a blob': () => new Blob([bytes]),
    'a stream of small pieces': () => streamOf(bytes, 7),
    'a stream of large pieces': () => streamOf(bytes, 5000),
    ranges: () => ({ size: bytes.length, read: async (offset, length) => bytes.slice(offset, offset + length) }),
  };
  for (const [way, given] of Object.entries(ways)) {
    test(`${name} from ${way}`, async () => assert.deepEqual(await readAll(given()), wanted));
  }
}
