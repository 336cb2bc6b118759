// Reductions after a blend: residual images, costs of removal and of dropping SH degrees, and SH terms of the colour refit.
// Twins: flexgs_edge.kernels.twins.score

// target - image, pixel by pixel.
__kernel void residual(
    const uint count,
    __global const half *target,      // [count]
    __global const float *image,      // [count]
    __global float *out)              // [count]
{
  const size_t i = get_global_id(0) * W;
#if W == 1
  out[i] = vload_half(i, target) - image[i];
#else
  STOREF(CAT(vload_half, W)(0, target + i) - LOADF(image, i), out, i);
#endif
}

// Sum `plane` of W rows as float; 0 in lanes from `count` on, whose rows belong to other chunks.
inline FW sum_value(__global const long *sums, uint planes, uint plane, size_t row, int count, float unit) {
  float lanes[W];
  for (int l = 0; l < W; ++l) lanes[l] = l < count ? convert_float(sums[(row + l) * planes + plane]) : 0.0f;
  return LOADF(lanes, 0) * (FW)unit;
}

// acc[i] += value in fixed point. Sums over views have the same bits in any order, unless they reach the 64-bit limits: they stay there.
inline void add_long(__global long *acc, size_t i, FW value) {
  value = smaller(larger(value * (FW)FIXED_WEIGHT, (FW)-FIXED_LARGEST), (FW)FIXED_LARGEST);
#if W == 1
  acc[i] = add_sat(acc[i], convert_long_rtz(value));
#else
  // The built-in `add_sat` and conversions of wide vectors are slow: a call for each lane.
  typedef CAT(long, W) LW;
#ifdef HAS_CONVERT
  const LW more = __builtin_convertvector(value, LW);
#else
  const LW more = CAT(CAT(convert_long, W), _rtz)(value);
#endif
  const LW old = CAT(vload, W)(0, acc + i), sum = CAT(as_long, W)(CAT(as_ulong, W)(old) + CAT(as_ulong, W)(more));
  const LW most = (old >> 63) ^ (LW)LONG_MAX, beyond = ((old ^ sum) & (more ^ sum)) >> 63;
  CAT(vstore, W)((sum & ~beyond) | (most & beyond), 0, acc + i);
#endif
}

// `view_direction` of rows that this view sees. A row at the camera's own position has no direction: NaN, which would stay NaN also
// with its weight of 0.
inline void seen_direction(IW some, __global const float *camera, __global const float *means, size_t s, size_t i, FW *x, FW *y,
                           FW *z) {
  view_direction(camera, LOADF(means, i), LOADF(means, s + i), LOADF(means, 2 * s + i), x, y, z);
  *x = pick(some, *x, (FW)0.0f);
  *y = pick(some, *y, (FW)0.0f);
  *z = pick(some, *z, (FW)0.0f);
}

// Index of row i in plane `plane` of `planes` planes of sums over views, which lie in groups of SUM_LANES rows.
#define SUM_AT(planes, plane, i) (((size_t)(i) / SUM_LANES * (planes) + (plane)) * SUM_LANES + (i) % SUM_LANES)

// Adds one view to the costs. First come the squared error of removal and the squared weight w2: two planes each, the low and the
// high 64 bits of a sum that never overflows. Then, for every lower degree L, let d be the colour that the bands above L add in this
// view: the moments w2 d (three channels) and w2 |d|^2. They give the cost of dropping the bands if the weighted mean colour is kept.
__kernel void add_costs(
    const uint count,                   // rows of this part of the view
    const uint stride,
    const uint base,                    // row of the view that the part starts at
    const uint first,                   // place of its first block in `blocks`
    const uint degree,                  // SH degree of the chunk, or 0 for no moments
    const uint planes,                  // S
    const uint plane,                   // which of them holds the squared errors; the squared weights follow
    __global const uint *blocks,        // blocks of the chunk, ascending
    __global const float *camera,       // [32]
    __global const float *means,        // [3, stride]
    __global const float *sh_rest,      // [3 * K, stride]
    __global const long *sums,          // [N, S] from a blend with removal costs
    __global long *costs)               // [stride / SUM_LANES, 4 + 4 * degree, SUM_LANES]
{
  const size_t n = get_global_id(0) * W, s = stride;
  if (n >= count) return;
  const size_t i = row_of(blocks, first, n);
  const int there = (int)min(count - (uint)n, (uint)W);
  const uint all_planes = 4 + 4 * degree;
  for (uint k = 0; k < 2; ++k)
    for (int l = 0; l < there; ++l) {
      const ulong value = (ulong)sums[(base + n + l) * planes + plane + k];
      __global ulong *low = (__global ulong *)costs + SUM_AT(all_planes, 2 * k, i + l);
      const ulong sum = *low + value;
      *low = sum;
      low[SUM_LANES] += sum < value;
    }
  if (degree == 0) return;
  const FW w2 = sum_value(sums, planes, plane + 1, base + n, there, 1.0f / FIXED_ERROR);
  const IW some = MASK(w2 > (FW)0.0f);
  if (!ANY(some)) return;
  FW x, y, z;
  seen_direction(some, camera, means, s, i, &x, &y, &z);
  FW basis[24];
  FOR_EACH_BASIS(degree, x, y, z, KEEP_BASIS)
  const int all = (int)((degree + 1) * (degree + 1)) - 1;
  FW d[3] = {(FW)0.0f, (FW)0.0f, (FW)0.0f};
  for (int level = (int)degree - 1; level >= 0; --level) {
    FW square = (FW)0.0f;
    for (int c = 0; c < 3; ++c) {
      for (int k = (level + 1) * (level + 1) - 1; k < (level + 2) * (level + 2) - 1; ++k)
        d[c] = fma(basis[k], LOADF(sh_rest, (size_t)(c * all + k) * s + i), d[c]);
      square = fma(d[c], d[c], square);
      add_long(costs, SUM_AT(all_planes, 4 + level * 4 + c, i), w2 * d[c]);
    }
    add_long(costs, SUM_AT(all_planes, 4 + level * 4 + 3, i), w2 * square);
  }
}

// Adds one view to the sums of the colour refit. For every basis function k (k = 0: the constant): Y_k sum(alpha T r) of three
// channels, and |Y_k| sum(alpha T). These are float sums, view after view, so the order of the views is part of the result.
__kernel void sh_residual(
    const uint count,                   // rows of this part of the view
    const uint stride,
    const uint base,
    const uint first,
    const uint degree,                  // SH degree of the chunk, 0 as well
    const uint planes,                  // S
    __global const uint *blocks,
    __global const float *camera,       // [32]
    __global const float *means,        // [3, stride]
    __global const long *sums,          // [N, S] from a blend with residuals: weight, red, green, blue first
    __global float *normal)             // [stride / SUM_LANES, K + 1, 4, SUM_LANES] red, green, blue, weight
{
  const size_t n = get_global_id(0) * W, s = stride;
  if (n >= count) return;
  const size_t i = row_of(blocks, first, n);
  FW seen[4];
  for (int c = 0; c < 4; ++c)
    seen[(c + 3) & 3] = sum_value(sums, planes, (uint)c, base + n, (int)min(count - (uint)n, (uint)W), 1.0f / FIXED_WEIGHT);
  const IW some = MASK(seen[3] > (FW)0.0f);
  if (!ANY(some)) return;
  FW x, y, z;
  seen_direction(some, camera, means, s, i, &x, &y, &z);
  FW basis[25];
#define KEEP_AFTER_CONSTANT(k, value) basis[(k) + 1] = value
  basis[0] = (FW)SH_C0;
  FOR_EACH_BASIS(degree, x, y, z, KEEP_AFTER_CONSTANT)
  const uint functions = (degree + 1) * (degree + 1);
  for (uint k = 0; k < functions; ++k) {
    __global float *at = normal + SUM_AT(4 * functions, 4 * k, i);
    for (int c = 0; c < 3; ++c) STOREF(fma(basis[k], seen[c], LOADF(at, c * SUM_LANES)), at, c * SUM_LANES);
    STOREF(fma(fabs(basis[k]), seen[3], LOADF(at, 3 * SUM_LANES)), at, 3 * SUM_LANES);
  }
}
