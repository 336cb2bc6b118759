import { i16, i32, u16 } from './bytes.js';
import { StreamError } from './errors.js';
import { shownBytes } from './shown-bytes.js';
import { decodeTables } from './tables.js';

const SCALES = ['scale x', 'scale y', 'scale z'];

/** The base channels in order, each with the earlier channels that predict it. */
export const BASE = [
  ['scale x', []],
  ['scale y', ['scale x']],
  ['scale z', ['scale x', 'scale y']],
  ['opacity', SCALES],
  ['dc Y', ['opacity', ...SCALES]],
  ['dc Co', ['dc Y', 'opacity']],
  ['dc Cg', ['dc Y', 'dc Co']],
  ['sh degree', ['opacity', 'dc Y', 'dc Co', 'dc Cg']],
  ['rotation x', SCALES],
  ['rotation y', SCALES],
  ['rotation z', SCALES],
];
/** Alphabets before those of the groups: the octree's and that of the repeats. */
const OCTREE = { contexts: 30, symbols: 256 };
const REPEATS = { contexts: 1, symbols: 16 };
const RECORD_BYTES = 14;
const CONTEXTS_MOST = 64;

/** A group of channels: one prediction, one alphabet. */
export class Group {
  constructor(name, features, residual) {
    this.name = name;
    this.features = features;
    this.residual = residual;
  }

  /** Read the record at byte `at`; returns the byte behind it. */
  read(bytes, at) {
    if (bytes.length < at + RECORD_BYTES) {
      throw new StreamError(`group ${this.name}: wanted ${RECORD_BYTES} bytes, got ${bytes.length - at}`);
    }
    const head = bytes.subarray(at, at + RECORD_BYTES);
    this.shift = bytes[at + 4];
    this.symbols = u16(bytes, at + 9);
    const [valueCuts, errorCuts, weighted] = [bytes[at + 11], bytes[at + 12], bytes[at + 13]];
    // The code of symbol 0, but for the prediction.
    this.start = (this.residual ? i32(bytes, at) : 0) + i32(bytes, at + 5);
    at += RECORD_BYTES;
    const each = this.features + 1;
    const size = weighted ? 4 * each : 0;
    const end = at + size + 4 * (valueCuts + errorCuts);
    const tooMany = this.symbols < 1 || this.symbols > 256 || Math.max(valueCuts, errorCuts) > 15;
    if (weighted > 1 || this.shift > 24 || tooMany || end > bytes.length) {
      throw new StreamError(`group ${this.name}: wanted a record within its limits, got ${shownBytes(head)}`);
    }
    const number = (i) => (weighted ? i16(bytes, at + 2 * i) : 0);
    this.valueWeights = Float64Array.from({ length: each }, (_, i) => number(i));
    this.errorWeights = Float64Array.from({ length: each }, (_, i) => number(each + i));
    this.levels = errorCuts + 1;
    this.contexts = (this.residual ? 2 : valueCuts + 1) * this.levels;
    if (this.contexts > CONTEXTS_MOST) {
      throw new StreamError(`group ${this.name}: wanted at most ${CONTEXTS_MOST} contexts, got ${this.contexts}`);
    }
    this.valueCuts = cuts(bytes, at + size, valueCuts, 4096);
    this.errorCuts = cuts(bytes, at + size + 4 * valueCuts, errorCuts, 1024);
    return end;
  }
}

/** Thresholds in units of P or E, sorted and padded to 16 for a search by halves. The order in a file does not matter. */
function cuts(bytes, at, count, unit) {
  const sorted = new Float64Array(16).fill(Infinity);
  for (let i = 0; i < count; i++) sorted[i] = i32(bytes, at + 4 * i) * unit;
  return sorted.sort();
}

/** The groups of a scene: base channels, then for each SH degree Y, Co and Cg. */
function makeGroups(shDegree) {
  const groups = BASE.map(([name, earlier]) => new Group(name, 3 + 3 * earlier.length, /^(scale|opacity|dc)/.test(name)));
  for (let degree = 1; degree <= shDegree; degree++) {
    ['Y', 'Co', 'Cg'].forEach((plane, i) => groups.push(new Group(`sh ${degree} ${plane}`, 9 + 3 * i, false)));
  }
  return groups;
}

/**
 * Read the model of a version 2 file.
 *
 * @param {Uint8Array} bytes without their checksum
 * @param {{shDegree: number, depth: number}} header
 */
export function readModel(bytes, header) {
  const groups = makeGroups(header.shDegree);
  let at = 0;
  for (const group of groups) at = group.read(bytes, at);
  const [octree, repeats, ...own] = decodeTables(bytes.subarray(at), [OCTREE, REPEATS, ...groups]);
  groups.forEach((group, i) => (group.tables = own[i]));
  return { shDegree: header.shDegree, depth: header.depth, octree, repeats, groups };
}
