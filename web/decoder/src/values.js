// Codes to values. Each operation is rounded to binary32 once, so that all decoders give the same bits: `Math.fround` of a
// double's sum, product or root is exact.

import { expand } from './contraction.js';

const fround = Math.fround;

/**
 * Values of a version 2 chunk: planes one after the other, as in the program.
 *
 * @param {object} codes from `decodeChunk`
 * @param {object} header
 * @returns {Record<string, Float32Array>} positions are relative to the origin
 */
export function values2(codes, header) {
  const rows = codes.opacity.length;
  const { steps, shDegree } = header;
  const chroma = (step) => fround(step * steps.chroma);
  const means = new Float32Array(3 * rows);
  const logScales = new Float32Array(3 * rows);
  for (let axis = 0; axis < 3; axis++) {
    scaled(codes.position[axis], steps.position, means.subarray(axis * rows));
    scaled(codes.scale[axis], steps.scale, logScales.subarray(axis * rows));
  }
  if (steps.contraction) expand(means, rows, steps.contraction);
  const opacityLogits = new Float32Array(rows);
  scaled(codes.opacity, steps.opacity, opacityLogits);
  const quats = new Float32Array(4 * rows);
  rotations(codes.rotation[0], codes.rotation[1], codes.rotation[2], steps.rotation, rows, quats);
  const shDc = new Float32Array(3 * rows);
  const everyRow = Int32Array.from({ length: rows }, (_, i) => i);
  colours(codes.dc[0], codes.dc[1], codes.dc[2], steps.dc, chroma(steps.dc), everyRow, shDc, 0, rows, 2 * rows);
  const each = (shDegree + 1) ** 2 - 1;
  const shRest = new Float32Array(3 * each * rows);
  codes.sh.forEach((band, i) => {
    const width = 2 * i + 3;
    const step = steps.sh[i];
    for (let k = 0; k < width; k++) {
      const [y, co, cg] = [0, 1, 2].map((plane) => band.planes[plane * width + k]);
      const red = ((i + 1) ** 2 - 1 + k) * rows;
      colours(y, co, cg, step, chroma(step), band.rows, shRest, red, red + each * rows, red + 2 * each * rows);
    }
  });
  return { means, shDc, shRest, opacityLogits, logScales, quats };
}

function scaled(codes, step, out) {
  for (let i = 0; i < codes.length; i++) out[i] = codes[i] * step;
}

function rotations(a, b, c, step, rows, out) {
  for (let i = 0; i < rows; i++) {
    const x = fround(a[i] * step);
    const y = fround(b[i] * step);
    const z = fround(c[i] * step);
    const square = fround(1 - fround(fround(fround(x * x) + fround(y * y)) + fround(z * z)));
    out[i] = square > 0 ? Math.sqrt(square) : 0;
    out[rows + i] = x;
    out[2 * rows + i] = y;
    out[3 * rows + i] = z;
  }
}

function colours(y, co, cg, step, chroma, rows, out, red, green, blue) {
  for (let i = 0; i < rows.length; i++) {
    const luma = fround(y[i] * step);
    const c = fround(fround(co[i] * chroma) * 0.5);
    const h = fround(fround(cg[i] * chroma) * 0.5);
    const rest = fround(luma - h);
    const row = rows[i];
    out[red + row] = rest + c;
    out[green + row] = luma + h;
    out[blue + row] = rest - c;
  }
}
