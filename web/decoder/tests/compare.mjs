// node compare.mjs FOLDER: read each file that FOLDER/expected.json names, and print as JSON what differs from it. A file is
// read from memory, and as a stream; `seconds` is the longest that one took.
import { readFileSync } from 'node:fs';
import { join } from 'node:path';
import { FgsError } from '../src/index.js';
import { readAll, streamOf } from './read.mjs';

const folder = process.argv[2];
const expected = JSON.parse(readFileSync(join(folder, 'expected.json'), 'utf8'));
const different = [];
let seconds = 0;

async function outcome(given, name) {
  const start = performance.now();
  try {
    return await readAll(given, { name });
  } catch (error) {
    return error instanceof FgsError ? { error: error.message } : { fault: String(error.stack) };
  } finally {
    seconds = Math.max(seconds, (performance.now() - start) / 1000);
  }
}

function same(one, two) {
  return JSON.stringify(one) === JSON.stringify(two);
}

for (const [name, wanted] of Object.entries(expected)) {
  const bytes = new Uint8Array(readFileSync(join(folder, name)));
  const got = await outcome(bytes, name);
  if (!same(got, wanted)) different.push({ name, way: 'memory', wanted, got });
  // A stream may notice a fault elsewhere first, but it takes and refuses the same files.
  const streamed = await outcome(streamOf(bytes, 1000), name);
  const alike = 'error' in wanted ? 'error' in streamed : same(streamed, wanted);
  if (!alike) different.push({ name, way: 'stream', wanted, got: streamed });
}
console.log(JSON.stringify({ files: Object.keys(expected).length, seconds, different }));
