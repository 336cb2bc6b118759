import { NO_SH, TEXELS } from './pack.js';

/** The share of a scene's rows that fits, of rows and of rows with SH: at most 1. */
export function shareOf({ count, shRows }, most) {
  return Math.min(1, most.count / Math.max(count, 1), most.shRows / Math.max(shRows, 1));
}

/**
 * Those rows of a packed chunk that show most, packed alike.
 *
 * @param {number} share of its rows that stay
 * @param {{start: number, shStart: number}} at where they go
 * @param {number} shWords words of a row's SH
 */
export function thinChunk({ data, sh, means, importance, rows, shStart, index }, share, at, shWords) {
  const kept = strongest(importance, Math.floor(share * rows));
  const some = new Uint32Array(kept.length * TEXELS * 4);
  const someSh = new Uint32Array(Math.min(sh.length, kept.length * shWords));
  const places = new Float32Array(3 * kept.length);
  let shRows = 0;
  kept.forEach((row, to) => {
    const from = row * TEXELS * 4;
    some.set(data.subarray(from, from + TEXELS * 4), to * TEXELS * 4);
    for (let axis = 0; axis < 3; axis++) places[axis * kept.length + to] = means[axis * rows + row];
    const own = data[from + 3];
    if (own === NO_SH) return;
    const first = (own - shStart) * shWords;
    someSh.set(sh.subarray(first, first + shWords), shRows * shWords);
    some[to * TEXELS * 4 + 3] = at.shStart + shRows++;
  });
  const shown = Float32Array.from(kept, (row) => importance[row]);
  return { index, ...at, rows: kept.length, data: some, sh: someSh.slice(0, shRows * shWords), shRows, means: places, importance: shown };
}

/** Places of the `count` largest values, ascending. */
function strongest(values, count) {
  const order = Uint32Array.from(values.keys()).sort((a, b) => values[b] - values[a] || a - b);
  return order.slice(0, count).sort();
}
