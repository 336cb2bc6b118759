// A .fgs as splats of Spark (https://sparkjs.dev), which draws them in a scene of three.js.
import { ExtSplats, utils } from '@sparkjsdev/spark';

const SH_C0 = 0.28209479177387814;
/** Where Spark keeps the coefficients of a splat: 16 words in four arrays, the last of them unused. */
const PLACES = ['sh1', 'sh2', 'sh3a', 'sh3b'];
const MOST_DEGREE = 3;

/**
 * Decode a file into splats. Positions are relative to `file.origin`; SH of degree 4 are left out, since Spark has none.
 *
 * @param {import('@flexgs/decoder').FgsFile} file
 * @returns {Promise<ExtSplats>} 32 bytes a splat, 96 with SH: float32 positions, half floats
 */
export async function splatsOf(file) {
  const degree = Math.min(file.shDegree, MOST_DEGREE);
  // Whole lines of a texture: of arrays that end before, Spark leaves out the last line.
  const size = utils.getTextureSize(Math.max(1, file.count)).maxSplats;
  const extArrays = [new Uint32Array(4 * size), new Uint32Array(4 * size)];
  const extra = {};
  const arrays = PLACES.slice(0, [0, 1, 2, 4][degree]).map((name) => (extra[name] = new Uint32Array(4 * size)));
  for await (const chunk of file.chunks({ sh: degree > 0 })) {
    const values = chunk.values();
    putSplats(extArrays, chunk.start, chunk.rows, values);
    if (degree) putSh(arrays, chunk.start, chunk.rows, values.shRest, degree, file.shDegree);
  }
  const splats = new ExtSplats({ extArrays, numSplats: file.count, extra });
  await splats.initialized;
  return splats;
}

function putSplats(extArrays, start, rows, { means, logScales, quats, opacityLogits, shDc }) {
  for (let i = 0; i < rows; i++) {
    const of = (planes, axis) => planes[axis * rows + i];
    const opacity = 1 / (1 + Math.exp(-opacityLogits[i]));
    const [red, green, blue] = [0, 1, 2].map((axis) => 0.5 + SH_C0 * of(shDc, axis));
    const [sx, sy, sz] = [0, 1, 2].map((axis) => Math.exp(of(logScales, axis)));
    const [w, x, y, z] = [0, 1, 2, 3].map((axis) => of(quats, axis));
    const length = Math.hypot(w, x, y, z) || 1;
    utils.encodeExtSplat(
      extArrays, start + i, of(means, 0), of(means, 1), of(means, 2), sx, sy, sz,
      x / length, y / length, z / length, w / length, opacity, red, green, blue,
    ); // prettier-ignore
  }
}

/** A word for each coefficient: three numbers of 8 bits with their exponent. */
function putSh(arrays, start, rows, shRest, degree, fileDegree) {
  const each = (fileDegree + 1) ** 2 - 1;
  const used = (degree + 1) ** 2 - 1;
  for (let k = 0; k < used; k++) {
    const [array, place] = [arrays[k >> 2], k & 3];
    for (let i = 0; i < rows; i++) {
      const [red, green, blue] = [0, 1, 2].map((colour) => shRest[(colour * each + k) * rows + i]);
      array[4 * (start + i) + place] = sharedExponent(red, green, blue);
    }
  }
}

/**
 * The word that Spark decodes to three numbers: 8 bits each, their signs, and one exponent of 5 bits. Spark's own `encodeExtRgb`
 * takes the exponent below the largest number, and cuts that number off at the power of two, to as little as half.
 */
function sharedExponent(...numbers) {
  const sizes = numbers.map(Math.abs);
  const exponent = Math.min(31, Math.max(0, Math.ceil(Math.log2(Math.max(...sizes))) + 15));
  const unit = 2 ** (exponent - 15) / 255;
  return numbers.reduce(
    (word, number, k) => word | (Math.min(255, Math.round(sizes[k] / unit)) << (8 * k)) | ((number < 0 ? 1 : 0) << (24 + k)),
    exponent << 27,
  );
}

/** What makes Spark draw a model as INRIA's renderer and `flexgs-edge render` do; its own defaults are others. */
export function sparkOptions(antialiased = false) {
  const blur = antialiased ? { preBlurAmount: 0, blurAmount: 0.3 } : { preBlurAmount: 0.3, blurAmount: 0 };
  // By default it leaves out parts of large splats, and those whose centres lie outside of the picture.
  const whole = { maxPixelRadius: 4096, clipXY: 1e6, accumExtSplats: true };
  return { ...blur, ...whole, minAlpha: 1 / 255, maxStdDev: 3.33, sortRadial: false };
}

/** In Spark's vertex shader, where the shape of a splat in the picture follows from its centre. */
const SHAPE = 'vec2 J2 = -(J1 * viewCenter.xy) * invZ;';
const LIMITED_SHAPE = `vec2 most = 1.3 / vec2(projectionMatrix[0][0], projectionMatrix[1][1]);
        vec2 J2 = -(J1 * clamp(viewCenter.xy * invZ, -most, most) * viewCenter.z) * invZ;`;

/**
 * Limit how large splats far outside of the picture become, as `flexgs-edge render` does: Spark has no option for it.
 *
 * @param {SparkRenderer} spark not drawn yet
 */
export function limitSides({ material }) {
  if (!material.vertexShader.includes(SHAPE)) throw new Error('This version of Spark has another shader: take 2.2.');
  material.vertexShader = material.vertexShader.replace(SHAPE, LIMITED_SHAPE);
}
