const SINGLE = new Float32Array(1);
const SINGLE_BITS = new Uint32Array(SINGLE.buffer);

/** The bits of the nearest half float; values beyond its range are cut off. */
export function toHalf(value) {
  SINGLE[0] = Math.min(65504, Math.max(-65504, value));
  const bits = SINGLE_BITS[0];
  const sign = (bits >>> 16) & 0x8000;
  const exponent = ((bits >>> 23) & 255) - 112;
  const fraction = bits & 0x7fffff;
  if (exponent <= 0) {
    if (exponent < -10) return sign;
    const whole = fraction | 0x800000;
    return sign | rounded(whole, 14 - exponent);
  }
  return sign | rounded((exponent << 23) | fraction, 13);
}

/** Shift right, to the nearest, ties to even. */
function rounded(number, shift) {
  const kept = number >>> shift;
  const rest = number & ((1 << shift) - 1);
  const middle = 1 << (shift - 1);
  return kept + (rest > middle || (rest === middle && kept & 1) ? 1 : 0);
}
