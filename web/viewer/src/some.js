// What is drawn of more splats than there is room for. Each has a chance, which is larger for larger ones, and those that are drawn
// grow, so that they cover about what all do.

const STEPS = 32; // of the chance, to half of it
const AREA_POWER = 3 / 8;
const GROWING = 2 / 5;
const MOST_BELOW = 511;
const GOLDEN = 0x9e3779b1;
export const CHANCES = 4096;
export const ROW_BITS = 23;

/** The logarithm of the chance of a splat that shows so much (`importanceOf` in pack.js), in steps. */
export function levelOf(importance) {
  return CHANCES / 2 + (STEPS * AREA_POWER * importance) / Math.LN2;
}

/** What a factor on the area that a splat shows adds to its level, of the factor's logarithm to base 2. */
export function levelsOf(octaves) {
  return STEPS * AREA_POWER * octaves;
}

/** The level from which on all are drawn, if about so many are to be; `counts`: how many there are of each level. */
export function cutOf(counts, most) {
  let whole = counts.reduce((sum, count) => sum + count, 0);
  let some = 0;
  let cut = 0;
  while (cut < CHANCES && whole + some > most) {
    some = (some + counts[cut]) * 2 ** (-1 / STEPS);
    whole -= counts[cut++];
  }
  return cut;
}

/** Whether a row so many steps below that level is drawn. Rows side by side take turns. */
export function isTaken(row, below) {
  return below <= 0 || (below <= MOST_BELOW && Math.imul(row, GOLDEN) >>> 0 < 2 ** (32 - below / STEPS));
}

/** The logarithm of the factor on the scales of such a row. */
export function growthOf(below) {
  return below > 0 ? (below * Math.LN2 * GROWING) / STEPS : 0;
}
