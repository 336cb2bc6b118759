import { StreamError } from './errors.js';
import { CODE_LIMIT } from './limits.js';
import { limited, neighbours4, neighbours8, padKnown } from './passes.js';

/** Room for the channels of a chunk, which is used again for each. */
export class Room {
  constructor(rows) {
    this.contexts = new Uint8Array(rows);
    this.symbols = new Uint8Array(rows);
    this.bases = new Float64Array(rows);
    this.means = new Int32Array(rows);
    this.spreads = new Int32Array(rows);
    this.values = new Int16Array(rows);
    this.padded = new Int16Array(rows + 16);
    this.raw = new Float64Array(rows);
    this.p = new Float64Array(rows);
    this.e = new Float64Array(rows);
  }
}

/**
 * Decode one channel.
 *
 * @param {import('./rans.js').Decoder} stream
 * @param {import('./model.js').Group} group
 * @param {object} plan from `planPasses`
 * @param {Room} room its sums `p` and `e` hold what is known before; `values` gets the values, within +-16383
 * @param {Int32Array} codes gets the codes
 * @param {Int32Array | null} means gets the means of the neighbours, in 1/256; in the first pass, the value
 */
export function readChannel(stream, group, plan, room, codes, means) {
  for (const pass of plan.passes) {
    const { first, stride, count } = pass;
    if (pass.weights === null) {
      room.means.fill(0, 0, count);
      room.spreads.fill(0, 0, count);
    } else {
      padKnown(room.values, stride, pass.known, plan.reach, room.padded);
      const neighbours = plan.reach === 4 ? neighbours8 : neighbours4;
      neighbours(room.padded, pass.weights, count, room.means, room.spreads);
    }
    predict(group, room, first, stride, count);
    stream.get(group.tables, room.contexts, count, room.symbols);
    readRaw(stream, group, room, count);
    const outside = putCodes(room.bases, room.symbols, room.raw, 2 ** group.shift, group.symbols - 1, first, stride, count, codes);
    if (outside) throw new StreamError(`${group.name}: wanted codes within ${CODE_LIMIT}`);
    putValues(codes, first, stride, count, room.values);
    if (means !== null) {
      if (pass.weights === null) putOwnMeans(room.values, first, stride, count, means);
      else putMeans(room.means, first, stride, count, means);
    }
  }
}

function predict(group, room, first, stride, count) {
  const [v, w] = [group.valueWeights, group.errorWeights];
  const find = group.residual ? residualContexts : valueContexts;
  find(
    room.p, room.e, room.means, room.spreads, v[0], v[1], w[0], w[1], first, stride, count,
    group.valueCuts, group.errorCuts, group.levels, group.start, room.contexts, room.bases,
  ); // prettier-ignore
}

function residualContexts(p, e, means, spreads, v1, v2, w1, w2, first, stride, count, _, cuts, levels, start, contexts, bases) {
  for (let j = 0, row = first; j < count; j++, row += stride) {
    const value = p[row] + v1 * means[j] + v2 * spreads[j];
    const error = e[row] + w1 * means[j] + w2 * spreads[j];
    const whole = Math.floor(value * 2 ** -16 + 0.5);
    let b = cuts[7] <= error ? 8 : 0;
    if (cuts[b + 3] <= error) b += 4;
    if (cuts[b + 1] <= error) b += 2;
    if (cuts[b] <= error) b += 1;
    contexts[j] = value >= whole * 65536 ? levels + b : b;
    bases[j] = whole + start;
  }
}

function valueContexts(p, e, means, spreads, v1, v2, w1, w2, first, stride, count, marks, cuts, levels, start, contexts, bases) {
  for (let j = 0, row = first; j < count; j++, row += stride) {
    const value = p[row] + v1 * means[j] + v2 * spreads[j];
    const error = e[row] + w1 * means[j] + w2 * spreads[j];
    let a = marks[7] <= value ? 8 : 0;
    if (marks[a + 3] <= value) a += 4;
    if (marks[a + 1] <= value) a += 2;
    if (marks[a] <= value) a += 1;
    let b = cuts[7] <= error ? 8 : 0;
    if (cuts[b + 3] <= error) b += 4;
    if (cuts[b + 1] <= error) b += 2;
    if (cuts[b] <= error) b += 1;
    contexts[j] = a * levels + b;
    bases[j] = start;
  }
}

/** What follows a batch, into `room.raw`: the low bits of all symbols but the escapes, then the numbers of the escapes. */
function readRaw(stream, group, room, count) {
  const escape = group.symbols - 1;
  const escapes = countOf(room.symbols, count, escape);
  if (!group.shift && !escapes) {
    room.raw.fill(0, 0, count);
    return;
  }
  const low = new Float64Array(count - escapes);
  stream.raw(group.shift, low.length, low);
  const far = new Float64Array(escapes);
  stream.raw(32, escapes, far);
  let nextLow = 0;
  let nextFar = 0;
  for (let j = 0; j < count; j++) room.raw[j] = room.symbols[j] === escape ? far[nextFar++] | 0 : low[nextLow++];
}

function countOf(symbols, count, escape) {
  let found = 0;
  for (let j = 0; j < count; j++) if (symbols[j] === escape) found++;
  return found;
}

/** Returns whether a code is beyond what a file may hold. */
function putCodes(bases, symbols, raw, factor, escape, first, stride, count, codes) {
  let outside = false;
  for (let j = 0, row = first; j < count; j++, row += stride) {
    const symbol = symbols[j];
    const code = bases[j] + raw[j] + (symbol === escape ? 0 : symbol * factor);
    if (code > CODE_LIMIT || code < -CODE_LIMIT) outside = true;
    codes[row] = code;
  }
  return outside;
}

function putValues(codes, first, stride, count, values) {
  for (let j = 0, row = first; j < count; j++, row += stride) values[row] = limited(codes[row]);
}

function putMeans(from, first, stride, count, means) {
  for (let j = 0, row = first; j < count; j++, row += stride) means[row] = from[j];
}

function putOwnMeans(values, first, stride, count, means) {
  for (let j = 0, row = first; j < count; j++, row += stride) means[row] = 256 * values[row];
}
