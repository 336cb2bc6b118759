// node allocations.mjs FOLDER: read each .fgs of a folder and print as JSON the largest array that was made, and the bytes of all
// arrays together. Arrays are counted where they are made, also those that are freed again at once.
import { readdirSync, readFileSync } from 'node:fs';
import { join } from 'node:path';

const made = { largest: 0, all: 0 };
const NAMES = ['Int8', 'Uint8', 'Int16', 'Uint16', 'Int32', 'Uint32', 'Float32', 'Float64'].map((name) => `${name}Array`);
for (const name of NAMES) {
  globalThis[name] = new Proxy(globalThis[name], {
    construct(target, args) {
      const array = Reflect.construct(target, args, target);
      if (!(args[0] instanceof ArrayBuffer)) count(array.byteLength);
      return array;
    },
    // As a constructor of its own, `from` would make arrays of the proxy, one element after the other.
    get: (target, key) => (key === 'from' ? (...args) => counted(target.from(...args)) : Reflect.get(target, key)),
  });
}

function count(bytes) {
  made.largest = Math.max(made.largest, bytes);
  made.all += bytes;
}

function counted(array) {
  count(array.byteLength);
  return array;
}

const { open } = await import('../src/index.js');
const folder = process.argv[2];
const found = [];
for (const name of readdirSync(folder).filter((file) => file.endsWith('.fgs'))) {
  const bytes = new Uint8Array(readFileSync(join(folder, name)));
  Object.assign(made, { largest: 0, all: 0 });
  let refused = false;
  let most = 0;
  try {
    const file = await open(bytes);
    // What the file may hold at once: the rows of a chunk, each with all of its values.
    most = Math.min(file.count, 65536) * 4 * (14 + 3 * ((file.shDegree + 1) ** 2 - 1));
    for await (const chunk of file.chunks()) chunk.values();
  } catch {
    refused = true;
  }
  found.push({ name, size: bytes.length, refused, values: most, ...made });
}
console.log(JSON.stringify(found));
