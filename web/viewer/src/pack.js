// What lies in the textures. A Gaussian has 4 texels of 4 words: x y z and the place of its SH; log-scales and opacity (logit);
// quaternion w x y z; dc red green blue and its SH degree. SH lie apart as half floats, since most rows have none.
import { toHalf } from './half.js';

export const TEXTURE_WIDTH = 2048;
export const TEXELS = 4;
export const NO_SH = 0xffffffff;

/** Texels of a row's SH. */
export function shTexels(degree) {
  return Math.ceil((3 * ((degree + 1) ** 2 - 1)) / 8);
}

/** Rows of SH in a line of their texture. */
export function shPerLine(degree) {
  return degree ? Math.floor(TEXTURE_WIDTH / shTexels(degree)) : 1;
}

/**
 * Pack the values of a chunk.
 *
 * @param {import('../../decoder/src/index.js').Values} values
 * @param {number} rows
 * @param {number} degree of the scene
 * @param {number} shBefore rows with SH in the chunks before
 * @param {Uint8Array} [degrees] of the rows; files of version 1 do not tell
 */
export function packChunk(values, rows, degree, shBefore, degrees = rowDegrees(values.shRest, rows, degree)) {
  const data = new Uint32Array(rows * TEXELS * 4);
  const floats = new Float32Array(data.buffer);
  const each = (degree + 1) ** 2 - 1;
  let shRows = 0;
  const { means, logScales, opacityLogits, quats, shDc } = values;
  for (let i = 0, at = 0; i < rows; i++, at += 16) {
    floats[at] = means[i];
    floats[at + 1] = means[rows + i];
    floats[at + 2] = means[2 * rows + i];
    data[at + 3] = degrees[i] ? shBefore + shRows++ : NO_SH;
    floats[at + 4] = logScales[i];
    floats[at + 5] = logScales[rows + i];
    floats[at + 6] = logScales[2 * rows + i];
    floats[at + 7] = opacityLogits[i];
    floats[at + 8] = quats[i];
    floats[at + 9] = quats[rows + i];
    floats[at + 10] = quats[2 * rows + i];
    floats[at + 11] = quats[3 * rows + i];
    floats[at + 12] = shDc[i];
    floats[at + 13] = shDc[rows + i];
    floats[at + 14] = shDc[2 * rows + i];
    data[at + 15] = degrees[i];
  }
  const sh = new Uint32Array(shRows * shTexels(degree) * 4);
  packSh(values.shRest, rows, each, rowsWithSh(degrees, shRows), new Uint16Array(sh.buffer), 8 * shTexels(degree));
  return { data, sh, shRows, means: means.slice(), importance: importanceOf(values, rows) };
}

/** The highest degree of each row with a coefficient other than 0. */
function rowDegrees(shRest, rows, degree) {
  const degrees = new Uint8Array(rows);
  const each = (degree + 1) ** 2 - 1;
  for (let plane = 0; plane < 3 * each; plane++) {
    const of = Math.floor(Math.sqrt((plane % each) + 1));
    raise(shRest, plane * rows, rows, of, degrees);
  }
  return degrees;
}

function raise(shRest, from, rows, degree, degrees) {
  for (let i = 0; i < rows; i++) if (shRest[from + i] !== 0 && degrees[i] < degree) degrees[i] = degree;
}

function rowsWithSh(degrees, count) {
  const some = new Int32Array(count);
  for (let i = 0, at = 0; i < degrees.length; i++) if (degrees[i]) some[at++] = i;
  return some;
}

function packSh(shRest, rows, each, some, halves, width) {
  for (let plane = 0; plane < 3 * each; plane++) {
    const [colour, k] = [Math.floor(plane / each), plane % each];
    packPlane(shRest, plane * rows, some, halves, width, 3 * k + colour);
  }
}

function packPlane(shRest, from, some, halves, width, place) {
  for (let i = 0, at = place; i < some.length; i++, at += width) {
    const value = shRest[from + some[i]];
    if (value) halves[at] = toHalf(value);
  }
}

/** How much a splat shows, roughly: the log of its opacity times the area of its two longer axes. */
function importanceOf({ logScales, opacityLogits }, rows) {
  const importance = new Float32Array(rows);
  for (let i = 0; i < rows; i++) {
    const a = logScales[i];
    const b = logScales[rows + i];
    const c = logScales[2 * rows + i];
    importance[i] = a + b + c - Math.min(a, b, c) - Math.log1p(Math.exp(-opacityLogits[i]));
  }
  return importance;
}
