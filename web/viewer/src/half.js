const SINGLE = new Float32Array(1);
const SINGLE_BITS = new Uint32Array(SINGLE.buffer);

/** The bits of the nearest half float, of two the even one; values beyond its range are cut off. */
export function toHalf(value) {
  const size = Math.min(65504, Math.abs(value));
  const small = size < 2 ** -14;
  // A single has the steps of small halves from 1/2 on, so that the sum rounds to them.
  SINGLE[0] = small ? size + 0.5 : size;
  const [bits] = SINGLE_BITS;
  const sign = value < 0 ? 0x8000 : 0;
  return sign | (small ? bits - 0x3f000000 : (bits + 0xfff + ((bits >>> 13) & 1) - 0x38000000) >>> 13);
}
