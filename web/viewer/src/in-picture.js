import { dot } from './vectors.js';

/** Where a place is in the picture, from the eye on; nowhere if it lies before `near`. */
export function inPicture(away, { rotation, fx, fy, cx, cy }, near) {
  const [x, y, z] = [0, 3, 6].map((row) => dot(rotation.slice(row, row + 3), away));
  return z > near ? [(fx * x) / z + cx + 0.5, (fy * y) / z + cy + 0.5] : [];
}
