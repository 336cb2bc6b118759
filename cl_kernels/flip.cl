// LDR-FLIP (Andersson et al. 2020): how different two pictures look to somebody who flips between them.
// Twins: flexgs_edge.kernels.twins.flip. A work-item may read what lies beside its row or picture: only use elements inside.

#define FLIP_TAPS (2 * FLIP_REACH + 1)

// x^p for 0 <= x <= 1000 and 0 <= p <= 3.
inline FW flip_power(FW x, FW p) {
  const IW none = MASK(x < (FW)FLIP_LEAST);
  const FW power = fexp2_within(p * flog2(pick(none, (FW)1.0f, x)));
  return pick(none, (FW)0.0f, power);
}

inline FW flip_mix(FW r, FW g, FW b, float wr, float wg, float wb) { return ((FW)wr * r + (FW)wg * g) + (FW)wb * b; }

// Light of an sRGB value in [0, 1].
inline FW flip_line(FW s) {
  const FW curve = flip_power(quotient(s + (FW)0.055f, (FW)1.055f), (FW)2.4f);
  return pick(MASK(s > (FW)0.04045f), curve, quotient(s, (FW)12.92f));
}

// sRGB in [0, 1] becomes light, red against green and yellow against blue: Y, X - Y and Y - Z.
__kernel void flip_colours(
    const uint count,                   // elements of a plane that are wanted
    const uint plane,                   // elements from one plane to the next
    __global float *planes)             // [3, plane]
{
  const size_t i = get_global_id(0) * W;
  const FW r = flip_line(LOADF(planes, i)), g = flip_line(LOADF(planes + plane, i)), b = flip_line(LOADF(planes + 2 * (size_t)plane, i));
  const FW x = flip_mix(r, g, b, FLIP_XYZ_0, FLIP_XYZ_1, FLIP_XYZ_2);
  const FW y = flip_mix(r, g, b, FLIP_XYZ_3, FLIP_XYZ_4, FLIP_XYZ_5);
  const FW z = flip_mix(r, g, b, FLIP_XYZ_6, FLIP_XYZ_7, FLIP_XYZ_8);
  STOREF(y, planes, i);
  STOREF(x - y, planes + plane, i);
  STOREF(y - z, planes + 2 * (size_t)plane, i);
}

// Sums value * tap over 2 * `reach` + 1 elements `step` apart, of which the middle one is FLIP_REACH steps from `from`.
inline FW flip_filter(__global const float *from, __global const float *taps, size_t step, int reach) {
  FW sum = (FW)0.0f;
  for (int k = FLIP_REACH - reach; k <= FLIP_REACH + reach; ++k) sum = sum + (FW)taps[k] * LOADF(from, k * step);
  return sum;
}

// The planes filtered along the columns: light, red and green, yellow and blue twice, light for features three times.
__kernel void flip_columns(
    const uint count,                   // elements of a filtered plane: rows * stride
    const uint stride,                  // elements of a row, a multiple of 16
    const uint plane,                   // elements of a plane that is read: at least (rows + 2 FLIP_REACH) stride
    const uint filtered,                // elements from one filtered plane to the next
    __global const float *taps,         // [7, FLIP_TAPS]
    __global const float *planes,       // [3, plane]
    __global float *columns)            // [7, filtered]
{
  const size_t i = get_global_id(0) * W;
  __global const float *light = planes + i, *red = light + plane, *blue = red + plane;
  __global float *to = columns + i;
  STOREF(flip_filter(light, taps, stride, FLIP_FINE_REACH), to, 0);
  STOREF(flip_filter(red, taps + FLIP_TAPS, stride, FLIP_FINE_REACH), to, filtered);
  FW a = (FW)0.0f, b = (FW)0.0f, c = (FW)0.0f;
  for (int k = 0; k < FLIP_TAPS; ++k) {
    const FW value = LOADF(blue, (size_t)k * stride);
    a = a + (FW)taps[2 * FLIP_TAPS + k] * value;
    b = b + (FW)taps[3 * FLIP_TAPS + k] * value;
  }
  STOREF(a, to, 2 * (size_t)filtered);
  STOREF(b, to, 3 * (size_t)filtered);
  a = b = (FW)0.0f;
  for (int k = FLIP_REACH - FLIP_FEATURE_REACH; k <= FLIP_REACH + FLIP_FEATURE_REACH; ++k) {
    const FW value = LOADF(light, (size_t)k * stride);
    a = a + (FW)taps[4 * FLIP_TAPS + k] * value;
    b = b + (FW)taps[5 * FLIP_TAPS + k] * value;
    c = c + (FW)taps[6 * FLIP_TAPS + k] * value;
  }
  STOREF(a, to, 4 * (size_t)filtered);
  STOREF(b, to, 5 * (size_t)filtered);
  STOREF(c, to, 6 * (size_t)filtered);
}

// CIE's lightness curve of one of X, Y, Z.
inline FW flip_curve(FW t) {
  const FW edge = (FW)(6.0f / 29.0f);
  const FW root = flip_power(t, (FW)(1.0f / 3.0f));
  return pick(MASK(t > edge * edge * edge), root, quotient(t, (FW)3.0f * edge * edge) + (FW)(4.0f / 29.0f));
}

// Filters along the rows too. What is compared later: L, a and b of the filtered colour, strength of edges and of points.
__kernel void flip_rows(
    const uint count,
    const uint filtered,                // at least count + 2 FLIP_REACH
    __global const float *taps,         // [7, FLIP_TAPS]
    __global const float *columns,      // [7, filtered]
    __global float *seen)               // [5, count]
{
  const size_t i = get_global_id(0) * W;
  __global const float *from = columns + i;
  const FW light = flip_filter(from, taps, 1, FLIP_FINE_REACH);
  const FW red = flip_filter(from + filtered, taps + FLIP_TAPS, 1, FLIP_FINE_REACH);
  const FW blue = flip_filter(from + 2 * (size_t)filtered, taps + 2 * FLIP_TAPS, 1, FLIP_REACH) +
                  flip_filter(from + 3 * (size_t)filtered, taps + 3 * FLIP_TAPS, 1, FLIP_REACH);
  FW rgb[3], f[3];
  const FW x = light + red, z = light - blue;
  rgb[0] = flip_mix(x, light, z, FLIP_RGB_0, FLIP_RGB_1, FLIP_RGB_2);
  rgb[1] = flip_mix(x, light, z, FLIP_RGB_3, FLIP_RGB_4, FLIP_RGB_5);
  rgb[2] = flip_mix(x, light, z, FLIP_RGB_6, FLIP_RGB_7, FLIP_RGB_8);
  for (int c = 0; c < 3; ++c) rgb[c] = smaller(larger(rgb[c], (FW)0.0f), (FW)1.0f);
  f[0] = flip_curve(flip_mix(rgb[0], rgb[1], rgb[2], FLIP_XYZ_0, FLIP_XYZ_1, FLIP_XYZ_2));
  f[1] = flip_curve(flip_mix(rgb[0], rgb[1], rgb[2], FLIP_XYZ_3, FLIP_XYZ_4, FLIP_XYZ_5));
  f[2] = flip_curve(flip_mix(rgb[0], rgb[1], rgb[2], FLIP_XYZ_6, FLIP_XYZ_7, FLIP_XYZ_8));
  // Colours of dark pixels count less (Hunt effect): a and b are scaled by the lightness.
  const FW lightness = (FW)116.0f * f[1] - (FW)16.0f, hunt = (FW)0.01f * lightness;
  STOREF(lightness, seen, i);
  STOREF(hunt * ((FW)500.0f * (f[0] - f[1])), seen + count, i);
  STOREF(hunt * ((FW)200.0f * (f[1] - f[2])), seen + 2 * (size_t)count, i);

  __global const float *smooth = from + 4 * (size_t)filtered, *slope = smooth + filtered, *bend = slope + filtered;
  FW edge_x = (FW)0.0f, edge_y = (FW)0.0f, point_x = (FW)0.0f, point_y = (FW)0.0f;
  for (int k = FLIP_REACH - FLIP_FEATURE_REACH; k <= FLIP_REACH + FLIP_FEATURE_REACH; ++k) {
    const FW value = LOADF(smooth, k), even = (FW)taps[4 * FLIP_TAPS + k];
    edge_x = edge_x + (FW)taps[5 * FLIP_TAPS + k] * value;
    edge_y = edge_y + even * LOADF(slope, k);
    point_x = point_x + (FW)taps[6 * FLIP_TAPS + k] * value;
    point_y = point_y + even * LOADF(bend, k);
  }
  STOREF(sqrt(edge_x * edge_x + edge_y * edge_y), seen + 3 * (size_t)count, i);
  STOREF(sqrt(point_x * point_x + point_y * point_y), seen + 4 * (size_t)count, i);
}

// FLIP of two pictures, 0 to 1: the difference of colours, raised by that of edges and points.
__kernel void flip_pair(
    const uint count,
    __global const float *one,          // [5, count]
    __global const float *two,
    __global float *flip)               // [count]
{
  const size_t i = get_global_id(0) * W;
  FW away[5];
  for (int c = 0; c < 5; ++c) away[c] = LOADF(one + (size_t)c * count, i) - LOADF(two + (size_t)c * count, i);
  const FW colour = fabs(away[0]) + sqrt(away[1] * away[1] + away[2] * away[2]);
  const FW power = flip_power(colour, (FW)FLIP_COLOUR_POWER), knee = (FW)FLIP_KNEE, share = (FW)FLIP_KNEE_SHARE;
  const FW above = share + quotient(power - knee, (FW)FLIP_COLOUR_MOST - knee) * ((FW)1.0f - share);
  const FW of_colour = pick(MASK(power < knee), quotient(share, knee) * power, above);
  const FW of_feature = sqrt(larger(fabs(away[3]), fabs(away[4])) * (FW)0.70710678f);
  STOREF(flip_power(of_colour, (FW)1.0f - of_feature), flip, i);
}
