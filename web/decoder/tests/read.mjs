// What the tests share: read a whole file, and say what came out as checksums, in the order of docs/format.md.
import { crc32, hex8 } from '../src/bytes.js';
import { open } from '../src/index.js';

const bytesOf = (array) => new Uint8Array(array.buffer, array.byteOffset, array.byteLength);

function sum(arrays) {
  return hex8(arrays.reduce((before, array) => crc32(bytesOf(array), before), 0));
}

function codesOf(codes) {
  const { position, scale, rotation, opacity, dc, degrees, sh } = codes;
  const bands = sh.flatMap((band) => band.planes);
  return [...position, ...scale, ...rotation, opacity, ...dc, Int32Array.from(degrees), ...bands];
}

/** @returns {Promise<object>} as `expected` in tests/helpers/web_vectors.py */
export async function readAll(given, options) {
  const file = await open(given, options);
  const record = { version: file.version, count: file.count, sh_degree: file.shDegree, origin: file.origin };
  record.layers = file.layers;
  if (file.version === 2) record.codes = [];
  record.values = [];
  for await (const chunk of file.chunks()) {
    const { means, shDc, shRest, opacityLogits, logScales, quats } = chunk.values();
    if (file.version === 2) record.codes.push(sum(codesOf(chunk.codes)));
    record.values.push(sum([means, shDc, shRest, opacityLogits, logScales, quats]));
  }
  return record;
}

/** A stream that gives `bytes` in pieces. */
export function streamOf(bytes, piece) {
  let at = 0;
  return new ReadableStream({
    pull(controller) {
      if (at >= bytes.length) return controller.close();
      controller.enqueue(bytes.slice(at, at + piece));
      at += piece;
    },
  });
}
