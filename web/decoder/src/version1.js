// Version 1: bit-packed planes of codes, each a step between two ends of a group.

import { checkedContraction, checkedInteger, checkedOrigin, hasKeys } from './checks.js';
import { expand } from './contraction.js';
import { FgsError, HeaderError } from './errors.js';
import { parseJson, plain } from './json.js';
import { CHUNK_ROWS, COUNT_MOST, DEGREE_MOST, PREAMBLE_BYTES } from './limits.js';
import { shown, shownFloat } from './shown.js';

const KEYS = ['bits', 'count', 'groups', 'origin', 'settings', 'sh_count', 'sh_degree'];
/** The arrays in order: the name of their values here and in the program, their name in the header, their channels. */
const ARRAYS = [
  ['means', 'means', 'xyz', () => 3],
  ['shDc', 'sh_dc', 'dc', () => 3],
  ['shRest', 'sh_rest', 'rest', (degree) => 3 * ((degree + 1) ** 2 - 1)],
  ['opacityLogits', 'opacity_logits', 'opacity', () => 1],
  ['logScales', 'log_scales', 'scale', () => 3],
  ['quats', 'quats', 'rot', () => 4],
];
const NAMES = ARRAYS.map(([, , name]) => name).sort();
const SMALLEST_STEP = 2 ** -126;

/** Read and check the header; throws `HeaderError`. */
function decodeHeader1(bytes) {
  const record = parseJson(bytes);
  const contracted = record instanceof Map && record.has('contraction');
  if (!hasKeys(record, contracted ? [...KEYS, 'contraction'].sort() : KEYS)) {
    throw new HeaderError(`wanted an object with the keys ${KEYS.join(', ')} and perhaps contraction, got ${shown(record)}`);
  }
  const count = checkedInteger('count', record.get('count'), 0, COUNT_MOST);
  const shCount = checkedInteger('sh_count', record.get('sh_count'), 0, count);
  const [lowest, highest] = shCount ? [1, DEGREE_MOST] : [0, 0];
  const shDegree = checkedInteger('sh_degree', record.get('sh_degree'), lowest, highest);
  const bits = attributes('bits', record.get('bits'));
  for (const [name, value] of bits) bits.set(name, checkedInteger(`bits.${name}`, value, 1, 16));
  const arrays = ARRAYS.map(([key, field, name, width]) => {
    const rows = field === 'sh_rest' ? shCount : count;
    const value = attributes('groups', record.get('groups')).get(name);
    const groups = checkedInteger(`groups.${name}`, value, Math.min(rows, 1), rows);
    return { key, field, rows, channels: width(shDegree), bits: bits.get(name), groups };
  });
  const settings = record.get('settings');
  if (!(settings instanceof Map)) throw new HeaderError(`settings: wanted an object, got ${shown(settings)}`);
  const contraction = contracted ? checkedContraction(record.get('contraction')) : null;
  const rangesOffset = PREAMBLE_BYTES + bytes.length;
  const rangesBytes = 8 * arrays.reduce((sum, array) => sum + array.channels * array.groups, 0) + 4;
  const chunkCount = Math.ceil(count / CHUNK_ROWS);
  const header = {
    version: 1,
    count,
    shCount,
    shDegree,
    origin: checkedOrigin(record.get('origin')),
    contraction,
    settings: plain(settings),
    layers: [count],
    arrays,
    chunkCount,
    rangesOffset,
    rangesBytes,
    chunksOffset: rangesOffset + rangesBytes,
    tableBytes: 8 * chunkCount + 4,
  };
  const payload = arrays.reduce((sum, array) => sum + array.channels * planeBytes(array.rows, array.bits), 0);
  return { ...header, fileSize: header.chunksOffset + payload + header.tableBytes };
}

function wrongSize1(header, size) {
  return header.fileSize === size ? '' : `its counts, bits and groups make a file of ${header.fileSize}`;
}

function attributes(name, value) {
  if (hasKeys(value, NAMES)) return new Map(value);
  throw new HeaderError(`${name}: wanted an object with the keys ${NAMES.join(', ')}, got ${shown(value)}`);
}

function planeBytes(rows, bits) {
  return Math.floor((rows * bits + 7) / 8);
}

/** Chunk after chunk, with its bytes. */
function* planChunks1(header) {
  for (let index = 0; index < header.chunkCount; index++) {
    const start = index * CHUNK_ROWS;
    const rows = Math.min(CHUNK_ROWS, header.count - start);
    const bytes = header.arrays.reduce(
      (sum, array) => sum + array.channels * planeBytes(rowsIn(array, start), array.bits),
      0,
    );
    yield { index, layer: 0, start, rows, bytes };
  }
}

function rowsIn(array, start) {
  return Math.min(Math.max(array.rows - start, 0), CHUNK_ROWS);
}

/**
 * The lows and steps of each array.
 *
 * @param {string} name of the file, for errors
 * @param {Uint8Array} bytes of the ranges, without their checksum
 */
function readRanges(name, bytes, header) {
  const numbers = new Float32Array(bytes.slice().buffer);
  let at = 0;
  return header.arrays.map((array) => {
    const each = array.channels * array.groups;
    const range = { low: numbers.subarray(at, at + each), step: numbers.subarray(at + each, at + 2 * each) };
    const wrong = firstWrong(range, 2 ** array.bits - 1);
    if (wrong >= 0) {
      const [channel, group] = [Math.floor(wrong / array.groups), wrong % array.groups];
      const got = `low ${shownFloat(range.low[wrong])}, step ${shownFloat(range.step[wrong])}`;
      throw new FgsError(
        name,
        header.rangesOffset + 4 * at,
        `ranges of ${array.field}, channel ${channel}, group ${group}: wanted finite numbers and a step of 0 or a ` +
          `normal positive number, got ${got}`,
      );
    }
    at += 2 * each;
    return range;
  });
}

function firstWrong({ low, step }, most) {
  for (let i = 0; i < low.length; i++) {
    const highest = Math.fround(low[i] + Math.fround(most * step[i]));
    if (!Number.isFinite(low[i]) || !Number.isFinite(highest)) return i;
    if (step[i] !== 0 && !(step[i] >= SMALLEST_STEP)) return i;
  }
  return -1;
}

/** The codes of a chunk: for each array a plane for each channel. SH have fewer rows. */
function decodeCodes(header, start, bytes, sh) {
  const codes = {};
  let at = 0;
  for (const array of header.arrays) {
    const rows = rowsIn(array, start);
    const length = planeBytes(rows, array.bits);
    const wanted = sh || array.key !== 'shRest';
    codes[array.key] = [];
    for (let channel = 0; channel < array.channels; channel++, at += length) {
      if (wanted) codes[array.key].push(unpack(bytes.subarray(at, at + length), array.bits, rows));
    }
  }
  return codes;
}

function unpack(bytes, bits, rows) {
  const codes = new Uint16Array(rows);
  const mask = (1 << bits) - 1;
  for (let i = 0, bit = 0; i < rows; i++, bit += bits) {
    const at = bit >>> 3;
    // A code of 16 bits lies in up to three bytes; those beyond the end are masked off.
    const word = bytes[at] | (bytes[at + 1] << 8) | (bytes[at + 2] << 16);
    codes[i] = (word >>> (bit & 7)) & mask;
  }
  return codes;
}

/** Values of a chunk: low + code * step, each operation rounded to binary32. Rows without SH have zeros. */
function valuesOf(codes, header, ranges, start, rows) {
  const values = {};
  header.arrays.forEach((array, i) => {
    const out = new Float32Array(array.channels * rows);
    codes[array.key].forEach((plane, channel) => {
      const { low, step } = ranges[i];
      fill(plane, array.rows, array.groups, start, low, step, channel * array.groups, out, channel * rows);
    });
    values[array.key] = out;
  });
  if (header.contraction) expand(values.means, rows, header.contraction);
  return values;
}

function fill(plane, all, groups, start, low, step, first, out, to) {
  let group = -1;
  let end = -1;
  let base = 0;
  let size = 0;
  for (let i = 0; i < plane.length; i++) {
    while (start + i >= end) {
      group = group < 0 ? groupOf(start, all, groups) : group + 1;
      end = Math.floor(((group + 1) * all) / groups);
      base = low[first + group];
      size = step[first + group];
    }
    out[to + i] = base + Math.fround(plane[i] * size);
  }
}

/** The group that covers a row. */
function groupOf(row, all, groups) {
  let group = Math.min(Math.floor((row * groups) / all), groups - 1);
  while (Math.floor((group * all) / groups) > row) group--;
  while (Math.floor(((group + 1) * all) / groups) <= row) group++;
  return group;
}

/** What `formats.js` asks of a version. */
export const VERSION1 = {
  decodeHeader: decodeHeader1,
  wrongSize: wrongSize1,
  planChunks: planChunks1,
  shared: ({ rangesOffset, rangesBytes }) => ({ part: 'ranges', offset: rangesOffset, length: rangesBytes }),
  readShared: readRanges,
  wrongLength: (place, length) => (length === place.bytes ? '' : String(place.bytes)),
  decode({ header, shared }, place, bytes, { sh }) {
    const codes = decodeCodes(header, place.start, bytes, sh);
    return { codes, used: place.bytes, values: () => valuesOf(codes, header, shared, place.start, place.rows) };
  },
};
