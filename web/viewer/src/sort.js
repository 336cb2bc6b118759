// The order of drawing: back to front by depth along the view. Depths are float32, as in the program, and sorted stably by their
// bits, so that splats of equal depth keep the order of their rows.
import { cutOf, isTaken, CHANCES, levelOf, levelsOf, ROW_BITS } from './some.js';

const DIGIT_BITS = 11;
const SIZE = 1 << DIGIT_BITS;
const CONE = 0.02;
const UNSEEN = 96; // steps of the chance of what lies out of sight

/** Sorts growing lists of rows. */
export class Sorter {
  constructor() {
    this.parts = [];
    this.rows = 0;
    this.room = 0;
  }

  /** Add a chunk's planes of positions, and how much its rows show. It takes the place of one that begins at the same row. */
  add(means, importance, start = this.rows) {
    const others = this.parts.filter((part) => part.start !== start);
    this.parts = [...others, { means, importance, start }].sort((a, b) => a.start - b.start);
    this.rows = this.parts.reduce((sum, part) => sum + part.importance.length, 0);
    if (this.rows <= this.room) return;
    this.room = Math.ceil(1.5 * this.rows);
    for (const name of ['keys', 'spareKeys', 'places', 'spare']) this[name] = new Uint32Array(this.room);
    this.levels = new Uint16Array(this.room);
  }

  /**
   * The splat that a ray meets first, or about so: of those that show much, the nearest within a narrow cone.
   *
   * @param {number[]} eye where the ray begins
   * @param {number[]} way its direction, of length 1
   * @param {number} near as for `sort`
   * @returns {number[] | null} where it lies
   */
  pick(eye, way, near) {
    let [best, least] = [null, Infinity];
    for (const { means, importance } of this.parts) {
      const rows = importance.length;
      for (let i = 0; i < rows; i++) {
        const [x, y, z] = [means[i] - eye[0], means[rows + i] - eye[1], means[2 * rows + i] - eye[2]];
        const depth = x * way[0] + y * way[1] + z * way[2];
        if (!(depth > near) || depth >= least) continue;
        const radius = Math.exp(importance[i] / 2); // of a disc of its area
        const away2 = x * x + y * y + z * z - depth * depth;
        if (away2 < Math.min(radius, CONE * depth) ** 2) [best, least] = [[means[i], means[rows + i], means[2 * rows + i]], depth];
      }
    }
    return best;
  }

  /**
   * @param {number[]} view third row of the rotation, and minus its product with the eye: depth = x . view + view[3]
   * @param {number} near rows at this depth or before are left out
   * @param {Uint32Array} out gets the rows, back to front. Of more than `most`, it gets some; above `ROW_BITS` bits of the row, their words
   *   tell how far they are below the level from which on all are drawn
   * @param {number} [most]
   * @param {{eye: number[], wide: number}} [sight] a cone, by the square of its slope: what lies outside has a smaller chance
   * @returns {number} how many
   */
  sort(view, near, out, most = Infinity, { eye, wide } = { eye: [0, 0, 0], wide: Infinity }) {
    const { keys, places, spareKeys, spare, levels } = this;
    let count = 0;
    for (const part of this.parts) count = depths(part, view, near, keys, places, count);
    if (count > most) {
      const counts = new Uint32Array(CHANCES);
      let at = 0;
      for (const part of this.parts) at = rank(part, eye, wide, keys, places, levels, at, count, counts);
      count = choose(keys, places, levels, count, cutOf(counts, most));
    }
    pass(keys, places, count, 0, spareKeys, spare);
    pass(spareKeys, spare, count, DIGIT_BITS, keys, places);
    pass(keys, places, count, 2 * DIGIT_BITS, spareKeys, spare);
    reverse(spare, count, out);
    return count;
  }
}

const DEPTH = new Float32Array(1);
const DEPTH_WORD = new Uint32Array(DEPTH.buffer);

function depths({ means, start }, [x, y, z, offset], near, keys, places, count) {
  const rows = means.length / 3;
  for (let i = 0; i < rows; i++) {
    DEPTH[0] = x * means[i] + y * means[rows + i] + z * means[2 * rows + i] + offset;
    if (DEPTH[0] > near) {
      // Bits of positive floats sort as the floats do.
      keys[count] = DEPTH_WORD[0];
      places[count++] = start + i;
    }
  }
  return count;
}

/** The levels of those rows of a part that are at places `at` on: what is near shows more. */
function rank({ means, importance, start }, [x, y, z], wide, keys, places, levels, at, count, counts) {
  const rows = importance.length;
  for (; at < count && places[at] < start + rows; at++) {
    const row = places[at] - start;
    DEPTH_WORD[0] = keys[at];
    const depth2 = DEPTH[0] * DEPTH[0];
    const away2 = (means[row] - x) ** 2 + (means[rows + row] - y) ** 2 + (means[2 * rows + row] - z) ** 2;
    // The bits of a float are its logarithm, roughly.
    const level = levelOf(importance[row]) - levelsOf(2 * (keys[at] / 2 ** 23 - 127)) - (away2 - depth2 > wide * depth2 ? UNSEEN : 0);
    levels[at] = Math.max(0, Math.min(CHANCES - 1, level));
    counts[levels[at]]++;
  }
  return at;
}

function choose(keys, places, levels, count, cut) {
  let kept = 0;
  for (let i = 0; i < count; i++) {
    const below = Math.max(0, cut - levels[i]);
    if (!isTaken(places[i], below)) continue;
    keys[kept] = keys[i];
    places[kept++] = places[i] | (below << ROW_BITS);
  }
  return kept;
}

function pass(keys, places, count, shift, toKeys, toPlaces) {
  const starts = new Uint32Array(SIZE);
  for (let i = 0; i < count; i++) starts[(keys[i] >>> shift) & (SIZE - 1)]++;
  for (let d = 0, sum = 0; d < SIZE; d++) {
    const size = starts[d];
    starts[d] = sum;
    sum += size;
  }
  for (let i = 0; i < count; i++) {
    const to = starts[(keys[i] >>> shift) & (SIZE - 1)]++;
    toKeys[to] = keys[i];
    toPlaces[to] = places[i];
  }
}

function reverse(places, count, out) {
  for (let i = 0; i < count; i++) out[i] = places[count - 1 - i];
}
