// The order of drawing: back to front by depth along the view. Depths are float32, as in the program, and sorted stably by their
// bits, so that splats of equal depth keep the order of their rows.

const DIGIT_BITS = 11;
const SIZE = 1 << DIGIT_BITS;
const CONE = 0.02;

/** Sorts growing lists of rows. */
export class Sorter {
  constructor() {
    this.parts = [];
    this.rows = 0;
    this.threshold = -Infinity;
    this.share = 1;
  }

  /** Add a chunk's planes of positions, and how much its rows show. It takes the place of one that begins at the same row. */
  add(means, importance, start = this.rows) {
    const others = this.parts.filter((part) => part.start !== start);
    this.parts = [...others, { means, importance, start }].sort((a, b) => a.start - b.start);
    this.rows = this.parts.reduce((sum, part) => sum + part.importance.length, 0);
    this.keys = new Uint32Array(this.rows);
    this.spare = new Uint32Array(this.rows);
    this.places = new Uint32Array(this.rows);
    this.spareKeys = new Uint32Array(this.rows);
    this.setShare(this.share);
  }

  /** Draw only this share of the rows, those that show most. */
  setShare(share) {
    this.share = share;
    const drop = Math.floor((1 - share) * this.rows);
    this.threshold = drop > 0 ? this.#allImportance().sort()[drop] : -Infinity;
  }

  #allImportance() {
    const all = new Float32Array(this.rows);
    let at = 0;
    for (const { importance } of this.parts) {
      all.set(importance, at);
      at += importance.length;
    }
    return all;
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
   * @param {Uint32Array} out gets the rows, back to front
   * @returns {number} how many
   */
  sort(view, near, out) {
    let count = 0;
    for (const part of this.parts) count = depths(part, view, near, this.threshold, this.keys, this.places, count);
    const { keys, places, spareKeys, spare } = this;
    pass(keys, places, count, 0, spareKeys, spare);
    pass(spareKeys, spare, count, DIGIT_BITS, keys, places);
    pass(keys, places, count, 2 * DIGIT_BITS, spareKeys, spare);
    reverse(spare, count, out);
    return count;
  }
}

const DEPTH = new Float32Array(1);
const DEPTH_WORD = new Uint32Array(DEPTH.buffer);

function depths({ means, importance, start }, [x, y, z, offset], near, threshold, keys, places, count) {
  const rows = means.length / 3;
  for (let i = 0; i < rows; i++) {
    DEPTH[0] = x * means[i] + y * means[rows + i] + z * means[2 * rows + i] + offset;
    if (DEPTH[0] > near && importance[i] >= threshold) {
      // Bits of positive floats sort as the floats do.
      keys[count] = DEPTH_WORD[0];
      places[count++] = start + i;
    }
  }
  return count;
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
