import { NO_SH, TEXELS } from './pack.js';
import { cutOf, growthOf, isTaken, CHANCES, levelOf } from './some.js';

/** The share of a scene's rows that fits, of rows and of rows with SH: at most 1. */
export function shareOf({ count, shRows }, most) {
  return Math.min(1, most.count / Math.max(count, 1), most.shRows / Math.max(shRows, 1));
}

/**
 * Some rows of a packed chunk, packed alike, and larger.
 *
 * @param {number} share of its rows that stay
 * @param {{start: number, shStart: number}} at where they go
 * @param {number} shEnd where rows with SH have to end: those beyond lose them
 * @param {number} shWords words of a row's SH
 */
export function thinChunk({ data, sh, means, importance, rows, shStart, index }, share, at, shEnd, shWords) {
  const { kept, below } = chosen(importance, Math.floor(share * rows));
  const some = new Uint32Array(kept.length * TEXELS * 4);
  const floats = new Float32Array(some.buffer);
  const someSh = new Uint32Array(Math.min(sh.length, kept.length * shWords));
  const places = new Float32Array(3 * kept.length);
  const shown = new Float32Array(kept.length);
  let shRows = 0;
  kept.forEach((row, i) => {
    const [from, to] = [row * TEXELS * 4, i * TEXELS * 4];
    some.set(data.subarray(from, from + TEXELS * 4), to);
    const growth = growthOf(below[row]);
    for (let axis = 0; axis < 3; axis++) {
      floats[to + 4 + axis] += growth;
      places[axis * kept.length + i] = means[axis * rows + row];
    }
    shown[i] = importance[row] + 2 * growth;
    const own = data[from + 3];
    if (own === NO_SH) return;
    if (at.shStart + shRows >= shEnd) {
      some[to + 3] = NO_SH;
      some[to + 15] = 0; // its degree
      return;
    }
    const first = (own - shStart) * shWords;
    someSh.set(sh.subarray(first, first + shWords), shRows * shWords);
    some[to + 3] = at.shStart + shRows++;
  });
  return { index, ...at, rows: kept.length, data: some, sh: someSh.slice(0, shRows * shWords), shRows, means: places, importance: shown };
}

/** At most so many rows, ascending, and of each row of all how far it is below the level from which on all are kept. */
function chosen(importance, most) {
  const levels = Int32Array.from(importance, (value) => Math.max(0, Math.min(CHANCES - 1, levelOf(value))));
  const counts = new Uint32Array(CHANCES);
  for (const level of levels) counts[level]++;
  for (let cut = cutOf(counts, most); ; cut++) {
    const below = levels.map((level) => cut - level);
    const kept = [...below.keys()].filter((row) => isTaken(row, below[row]));
    if (kept.length <= most) return { kept, below };
  }
}
