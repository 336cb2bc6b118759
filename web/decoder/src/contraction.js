// Scene contraction: docs/format.md. Operations are those of the program, in doubles.
import { LARGEST } from './limits.js';

const OCTAVES = 64;

/** How many times as far away as in the grid a position is, from its distance there in radii. */
function growth(distance) {
  if (!(distance > 1)) return 1;
  const k = Math.min(Math.floor(distance) - 1, OCTAVES - 1);
  return ((distance - k) * 2 ** k) / distance;
}

/** Expand contracted positions, in place: planes x, y, z of so many rows. */
export function expand(means, rows, { centre: [x, y, z], radius }) {
  for (let i = 0; i < rows; i++) {
    const [a, b, c] = [means[i] - x, means[rows + i] - y, means[2 * rows + i] - z];
    const distance = Math.max(Math.abs(a), Math.abs(b), Math.abs(c)) / radius;
    if (!(distance > 1)) continue;
    const times = growth(distance);
    means[i] = clamped(x + a * times);
    means[rows + i] = clamped(y + b * times);
    means[2 * rows + i] = clamped(z + c * times);
  }
}

/** A box around what a box of contracted positions holds. */
export function expandBox({ low, high }, { centre, radius }) {
  const ends = [...low, ...high].map((value, i) => Math.abs(value - centre[i % 3]));
  const times = growth(Math.max(...ends) / radius);
  const grown = (value, axis) => clamped(centre[axis] + (value - centre[axis]) * times);
  return {
    low: low.map((value, axis) => Math.min(value, grown(value, axis))),
    high: high.map((value, axis) => Math.max(value, grown(value, axis))),
  };
}

function clamped(value) {
  return Math.min(Math.max(value, -LARGEST), LARGEST);
}
