// A step of a descent: values move along their gradients by Adam, and are rounded to the grid for the next view.
// Twins: flexgs_edge.kernels.twins.descend

// What a bit-priced value adds to its gradient: the price times its sign, less within a width of zero.
inline FW pull(FW away, float price, float width) { return quotient((FW)price * away, fabs(away) + (FW)width); }

#define ADD(plane, value)                                                                            \
  {                                                                                                  \
    __global float *at = gradient + (size_t)(plane) * s + i;                                         \
    const FW old = LOADF(at, 0);                                                                     \
    STOREF(pick(moves, old + (value), old), at, 0);                                                  \
  }

// Adds what the bits of values cost to their gradients, in rows that are `seen`. Positions cost nothing here. Values then move
// towards those that are frequent, which take few bits, unless pictures need them where they are.
inline void price_bits(size_t i, size_t s, IW seen, uint degree, __global const float *prices, __global const uint *degrees,
                       __global const float *values, __global float *gradient)
{
  const UW own_degree = degrees_at(degrees, i);
  IW moves = seen;
#define VALUE(plane) LOADF(values, (size_t)(plane) * s + i)
  for (int k = 0; k < 3; ++k) {
    ADD(AT_SCALE + k, pull(VALUE(AT_SCALE + k) - (FW)prices[26 + k], prices[0], prices[1]));
    ADD(AT_QUAT + 1 + k, pull(VALUE(AT_QUAT + 1 + k), prices[2], prices[3]));
  }
  ADD(AT_LOGIT, pull(VALUE(AT_LOGIT) - (FW)prices[29], prices[4], prices[5]));
  const uint bands = (degree + 1) * (degree + 1) - 1;
  for (uint k = 0; k <= bands; ++k) {
    const uint level = k == 0 ? 0 : k < 4 ? 1 : k < 9 ? 2 : k < 16 ? 3 : 4;
    moves = seen & MASK(own_degree >= (UW)level);
    __global const float *own = prices + 6 + 4 * level;
    const size_t from = k ? AT_SH + k - 1 : AT_DC, apart = k ? bands : 1;
    const FW red = VALUE(from), green = VALUE(from + apart), blue = VALUE(from + 2 * apart), both = red + blue;
    const FW luma = (both + (FW)2.0f * green) * (FW)0.25f - (FW)(k ? 0.0f : prices[30]);
    const FW orange = red - blue - (FW)(k ? 0.0f : prices[31]);
    const FW moss = ((FW)2.0f * green - both) * (FW)0.5f - (FW)(k ? 0.0f : prices[32]);
    const FW by_luma = pull(luma, own[0], own[1]) * (FW)0.25f;
    const FW by_orange = pull(orange, own[2], own[3]), by_moss = pull(moss, own[2], own[3]) * (FW)0.5f;
    const FW rest = by_luma - by_moss;
    ADD(from, rest + by_orange);
    ADD(from + apart, (FW)2.0f * (by_luma + by_moss));
    ADD(from + 2 * apart, rest - by_orange);
  }
#undef VALUE
}

// One step of Adam (Kingma & Ba 2015) for the rows that are `seen`; other rows keep their running means.
inline void adam(size_t i, size_t s, FW share, IW seen, uint planes, float decay_first, float decay_second,
                 __global const float *rates, __global const float *gradient, __global float *powers, __global float *first,
                 __global float *second, __global float *values)
{
  const FW old_first = LOADF(powers, i), old_second = LOADF(powers, s + i);
  const FW power_first = pick(seen, old_first * (FW)decay_first, old_first);
  const FW power_second = pick(seen, old_second * (FW)decay_second, old_second);
  STOREF(power_first, powers, i);
  STOREF(power_second, powers, s + i);
  const FW whole_first = quotient((FW)1.0f, (FW)1.0f - power_first), whole_second = quotient((FW)1.0f, (FW)1.0f - power_second);
  for (size_t k = 0; k < planes; ++k) {
    const size_t at = k * s + i;
    const FW raw = LOADF(gradient, at), m = LOADF(first, at), v = LOADF(second, at);
    const FW g = pick(seen & MASK(fabs(raw) >= (FW)GRADIENT_MIN), raw, (FW)0.0f);
    FW mean = fma((FW)decay_first, m, (FW)(1.0f - decay_first) * g);
    mean = pick(MASK(fabs(mean) >= (FW)GRADIENT_MIN), mean, (FW)0.0f);
    FW square = fma((FW)decay_second, v, (FW)(1.0f - decay_second) * (g * g));
    square = pick(MASK(square >= (FW)(GRADIENT_MIN * GRADIENT_MIN)), square, (FW)0.0f);
    const FW step = quotient(mean * whole_first, sqrt(square * whole_second) + (FW)GRADIENT_MIN);
    STOREF(pick(seen, mean, m), first, at);
    STOREF(pick(seen, square, v), second, at);
    const FW value = LOADF(values, at);
    STOREF(pick(seen, fma(-(FW)rates[k] * share, step, value), value), values, at);
  }
}

inline void follow_rows(size_t i, size_t s, uint planes, float share, __global const float *values, __global float *mean)
{
  for (size_t k = 0; k < planes; ++k) {
    const FW value = LOADF(values, k * s + i), old = LOADF(mean, k * s + i);
    STOREF(share < 1.0f ? fma((FW)share, value - old, old) : value, mean, k * s + i);
  }
}

// Rounds a value to the nearest multiple of a step; a step of 0 leaves it as it is.
inline FW on_grid(FW value, float step) { return step > 0.0f ? rint(quotient(value, (FW)step)) * (FW)step : value; }

// Rounds the values of W rows; arguments as in `snap`.
inline void snap_rows(size_t i, size_t s, uint degree, __global const float *steps, __global const float *values,
                      __global float *means, __global float *log_scales, __global float *quats, __global float *logits,
                      __global float *sh_dc, __global float *sh_rest)
{
#define VALUE(plane) LOADF(values, (size_t)(plane) * s + i)
  for (int k = 0; k < 3; ++k) {
    STOREF(on_grid(VALUE(k), steps[0]), means, k * s + i);
    STOREF(on_grid(VALUE(AT_SCALE + k), steps[1]), log_scales, k * s + i);
  }
  FW w = VALUE(AT_QUAT), x = VALUE(AT_QUAT + 1), y = VALUE(AT_QUAT + 2), z = VALUE(AT_QUAT + 3);
  if (steps[2] > 0.0f) {
    FW inv = quotient((FW)1.0f, sqrt(fma(z, z, fma(y, y, fma(x, x, w * w)))));
    inv = pick(MASK(w < (FW)0.0f), -inv, inv);
    x = on_grid(x * inv, steps[2]);
    y = on_grid(y * inv, steps[2]);
    z = on_grid(z * inv, steps[2]);
    w = sqrt(fmax((FW)1.0f - ((x * x + y * y) + z * z), (FW)0.0f));
  }
  STOREF(w, quats, i);
  STOREF(x, quats, s + i);
  STOREF(y, quats, 2 * s + i);
  STOREF(z, quats, 3 * s + i);
  STOREF(on_grid(VALUE(AT_LOGIT), steps[3]), logits, i);
  const uint bands = (degree + 1) * (degree + 1) - 1;
  for (uint k = 0; k <= bands; ++k) {
    // The constant first, then the coefficients of every degree.
    const uint level = k == 0 ? 0 : k < 4 ? 1 : k < 9 ? 2 : k < 16 ? 3 : 4;
    const float luma_step = steps[4 + 2 * level], chroma_step = steps[5 + 2 * level];
    const size_t from = k ? AT_SH + k - 1 : AT_DC, apart = k ? bands : 1;
    __global float *to = k ? sh_rest + (size_t)(k - 1) * s : sh_dc;
    FW red = VALUE(from), green = VALUE(from + apart), blue = VALUE(from + 2 * apart);
    if (luma_step > 0.0f) {
      const FW both = red + blue;
      const FW luma = on_grid((both + (FW)2.0f * green) * (FW)0.25f, luma_step);
      const FW half_orange = on_grid(red - blue, chroma_step) * (FW)0.5f;
      const FW half_green = on_grid(((FW)2.0f * green - both) * (FW)0.5f, chroma_step) * (FW)0.5f;
      const FW rest = luma - half_green;
      red = rest + half_orange;
      green = luma + half_green;
      blue = rest - half_orange;
    }
    STOREF(red, to, i);
    STOREF(green, to, apart * s + i);
    STOREF(blue, to, 2 * apart * s + i);
  }
}
#undef VALUE

// Writes the values that a file of these steps would decode to (flexgs_edge.grid.values.from_grid) into the planes that views draw.
__kernel void snap(
    const uint stride,
    const uint degree,
    __global const float *steps,           // [6 + 2 * 4] position, scale, rotation, opacity, luma and chroma of the constant and
                                           // of every SH degree; 0 where values stay as they are
    __global const float *values,          // [14 + 3 K, stride]
    __global float *means,                 // [3, stride]
    __global float *log_scales,            // [3, stride]
    __global float *quats,                 // [4, stride]
    __global float *logits,                // [stride]
    __global float *sh_dc,                 // [3, stride]
    __global float *sh_rest)               // [3 * K, stride]
{
  snap_rows(get_global_id(0) * W, stride, degree, steps, values, means, log_scales, quats, logits, sh_dc, sh_rest);
}

// Moves a running mean of values towards them by a share; a share of 1 begins it anew.
__kernel void follow(
    const uint stride,
    const uint planes,
    const float share,
    __global const float *values,          // [planes, stride]
    __global float *mean)                  // [planes, stride]
{
  follow_rows(get_global_id(0) * W, stride, planes, share, values, mean);
}

// A whole step: what bits cost is added to the gradients, values move, their running mean follows, and what the next view is drawn
// from is computed. In one pass, as each of these waits for memory.
__kernel void descend(
    const uint stride,
    const uint degree,
    const uint planes,
    const int antialiased,                 // as in activate.cl
    const int priced,                      // 0: bits cost nothing
    const int follows,                     // 0: the mean of values stays
    const float decay_first,               // of the running mean of gradients
    const float decay_second,              // of the running mean of their squares
    const float share,                     // of the mean of values, as in `follow`
    __global const float *rates,           // [planes] largest change of a step
    __global const float *prices,          // [33] price and width of scale, rotation, opacity, then of luma and of chroma of the
                                           // constant and of every SH degree; centres of 3 scales, opacity, Y, Co, Cg
    __global const float *steps,           // as in `snap`
    __global const uint *degrees,          // [stride] SH degree of each row: no gradient above it
    __global const float *pace,            // [stride] share of a whole step; 0 for rows that stay
    __global float *gradient,              // [planes, stride], planes = 14 + 3 K
    __global float *powers,                // [2, stride] both decays to the power of the steps that a row has made
    __global float *first,                 // [planes, stride]
    __global float *second,                // [planes, stride]
    __global float *values,                // [planes, stride]
    __global float *mean,                  // [planes, stride]
    __global float *means,                 // [3, stride]
    __global float *log_scales,            // [3, stride]
    __global float *quats,                 // [4, stride]
    __global float *logits,                // [stride]
    __global float *sh_dc,                 // [3, stride]
    __global float *sh_rest,               // [3 * K, stride]
    __global float *cov,                   // [6, stride]
    __global float *log2_opacity)          // [stride]
{
  const size_t i = get_global_id(0) * W;
  const FW moves = LOADF(pace, i);
  const IW seen = MASK(moves > (FW)0.0f);
  if (ANY(seen)) {
    if (priced) price_bits(i, stride, seen, degree, prices, degrees, values, gradient);
    adam(i, stride, moves, seen, planes, decay_first, decay_second, rates, gradient, powers, first, second, values);
  }
  if (follows) follow_rows(i, stride, planes, share, values, mean);
  snap_rows(i, stride, degree, steps, values, means, log_scales, quats, logits, sh_dc, sh_rest);
  activate_rows(i, stride, antialiased, log_scales, quats, logits, cov, log2_opacity);
}
