// The order of a channel's rows: first the multiples of 2^top, then the odd multiples of 2^(top - 1), and so on. A row has `reach`
// neighbours on either side among the rows of earlier passes.
import { VALUE_LIMIT } from './limits.js';

const COARSE_ROWS = 256;
/** Adding and subtracting it rounds a double below 2^51 to the nearest integer, ties to even. */
const TO_INTEGER = 1.5 * 2 ** 52;
const DISTANCE = new Float32Array(1);
const DISTANCE_BITS = new Int32Array(DISTANCE.buffer);

/**
 * Plan the passes over rows in these cells.
 *
 * @param {Int32Array[]} cells x, y, z
 * @param {number} count rows
 * @param {number} reach neighbours on each side, 4 or 2
 */
export function planPasses(cells, count, reach) {
  const near = new Int32Array(count);
  const top = count ? 32 - Math.clz32(Math.floor((count - 1) / COARSE_ROWS)) : 0;
  const passes = count ? [{ first: 0, stride: 1 << top, count: rowsOf(0, 1 << top, count), weights: null, known: 0 }] : [];
  const room = Math.ceil(count / 2) + 2 * reach;
  const padded = [new Int32Array(room), new Int32Array(room), new Int32Array(room)];
  for (let k = top - 1; k >= 0; k--) {
    const [first, stride] = [1 << k, 2 << k];
    const [rows, known] = [rowsOf(first, stride, count), rowsOf(0, stride, count)];
    const weights = new Uint16Array(rows * 2 * reach);
    cells.forEach((axis, i) => padKnown(axis, stride, known, reach, padded[i]));
    weigh(padded[0], padded[1], padded[2], cells[0], cells[1], cells[2], first, stride, rows, 2 * reach, weights, near);
    passes.push({ first, stride, count: rows, weights, known });
  }
  return { passes, near, reach };
}

function rowsOf(first, stride, count) {
  return Math.ceil((count - first) / stride);
}

/** The values at multiples of `stride`, with the ends repeated: row j of a pass lies between places j + reach - 1 and j + reach. */
export function padKnown(values, stride, known, reach, out) {
  for (let i = 0; i < reach - 1; i++) out[i] = values[0];
  let at = reach - 1;
  for (let i = 0; i < known; i++) out[at++] = values[i * stride];
  const last = values[(known - 1) * stride];
  for (let i = 0; i < reach; i++) out[at++] = last;
}

const SHARES = new Float32Array(8);

/** Weights of the neighbours, and the bits of the distance to the nearest: binary32, each operation rounded. */
function weigh(knownX, knownY, knownZ, x, y, z, first, stride, count, width, weights, near) {
  const fround = Math.fround;
  for (let j = 0, row = first; j < count; j++, row += stride) {
    const px = x[row];
    const py = y[row];
    const pz = z[row];
    let least = Infinity;
    let total = 0;
    for (let t = 0; t < width; t++) {
      const dx = knownX[j + t] - px;
      const dy = knownY[j + t] - py;
      const dz = knownZ[j + t] - pz;
      const square = fround(fround(fround(dx * dx) + fround(dy * dy)) + fround(dz * dz));
      if (square < least) least = square;
      const share = fround(1 / fround(square + 1));
      SHARES[t] = share;
      total = fround(total + share);
    }
    DISTANCE[0] = least + 1;
    near[row] = 256 * ((DISTANCE_BITS[0] >>> 23) - 126);
    const factor = fround(256 / total);
    const at = j * width;
    for (let t = 0; t < width; t++) weights[at + t] = fround(SHARES[t] * factor) + TO_INTEGER - TO_INTEGER;
  }
}

/** Weighted mean and spread of 8 neighbours, in 1/256. All sums fit 32 bits. */
export function neighbours8(v, weights, count, means, spreads) {
  for (let j = 0, at = 0; j < count; j++, at += 8) {
    const a = weights[at];
    const b = weights[at + 1];
    const c = weights[at + 2];
    const d = weights[at + 3];
    const e = weights[at + 4];
    const f = weights[at + 5];
    const g = weights[at + 6];
    const h = weights[at + 7];
    const low = Math.imul(a, v[j]) + Math.imul(b, v[j + 1]) + Math.imul(c, v[j + 2]) + Math.imul(d, v[j + 3]);
    const high = Math.imul(e, v[j + 4]) + Math.imul(f, v[j + 5]) + Math.imul(g, v[j + 6]) + Math.imul(h, v[j + 7]);
    const mean = (low + high) | 0;
    const m = (mean + 128) >> 8;
    means[j] = mean;
    spreads[j] =
      (Math.imul(a, Math.abs(v[j] - m)) + Math.imul(b, Math.abs(v[j + 1] - m)) +
        Math.imul(c, Math.abs(v[j + 2] - m)) + Math.imul(d, Math.abs(v[j + 3] - m)) +
        Math.imul(e, Math.abs(v[j + 4] - m)) + Math.imul(f, Math.abs(v[j + 5] - m)) +
        Math.imul(g, Math.abs(v[j + 6] - m)) + Math.imul(h, Math.abs(v[j + 7] - m))) | 0; // prettier-ignore
  }
}

/** The same of 4 neighbours. */
export function neighbours4(v, weights, count, means, spreads) {
  for (let j = 0, at = 0; j < count; j++, at += 4) {
    const a = weights[at];
    const b = weights[at + 1];
    const c = weights[at + 2];
    const d = weights[at + 3];
    const mean =
      (Math.imul(a, v[j]) + Math.imul(b, v[j + 1]) + Math.imul(c, v[j + 2]) + Math.imul(d, v[j + 3])) | 0;
    const m = (mean + 128) >> 8;
    means[j] = mean;
    spreads[j] =
      (Math.imul(a, Math.abs(v[j] - m)) + Math.imul(b, Math.abs(v[j + 1] - m)) +
        Math.imul(c, Math.abs(v[j + 2] - m)) + Math.imul(d, Math.abs(v[j + 3] - m))) | 0; // prettier-ignore
  }
}

/** Clip codes to the range that predictions use. */
export function limited(code) {
  return code > VALUE_LIMIT ? VALUE_LIMIT : code < -VALUE_LIMIT ? -VALUE_LIMIT : code;
}
