// SSIM (Wang et al. 2004): windowed moments along columns, then along rows.
// Twins: flexgs_edge.kernels.twins.similarity

// Moments of a, b, a a, b b and a b, windowed along the columns, for every element whose window is inside the image.
__kernel void ssim_columns(
    const uint count,                   // elements of a plane of moments: (height - SSIM_WINDOW + 1) stride
    const uint stride,                  // elements of a row, a multiple of 16
    const uint plane,                   // elements from one plane of moments to the next
    __global const float *taps,         // [SSIM_WINDOW]
    __global const float *a,            // [height, stride] in [0, 1]
    __global const float *b,
    __global float *moments)            // [5, plane]
{
  const size_t i = get_global_id(0) * W;
  FW ma = (FW)0.0f, mb = (FW)0.0f, maa = (FW)0.0f, mbb = (FW)0.0f, mab = (FW)0.0f;
  for (int k = 0; k < SSIM_WINDOW; ++k) {
    const FW va = LOADF(a, i + (size_t)k * stride), vb = LOADF(b, i + (size_t)k * stride), tap = (FW)taps[k];
    const FW ta = tap * va, tb = tap * vb;
    ma = ma + ta;
    mb = mb + tb;
    maa = maa + ta * va;
    mbb = mbb + tb * vb;
    mab = mab + ta * vb;
  }
  STOREF(ma, moments, i);
  STOREF(mb, moments, i + plane);
  STOREF(maa, moments, i + 2 * (size_t)plane);
  STOREF(mbb, moments, i + 3 * (size_t)plane);
  STOREF(mab, moments, i + 4 * (size_t)plane);
}

// The moments windowed along the rows, and SSIM. The last SSIM_WINDOW - 1 elements of a row read the next row: do not use them.
__kernel void ssim_rows(
    const uint count,
    const uint plane,                   // at least count + SSIM_WINDOW - 1
    __global const float *taps,
    __global const float *moments,      // [5, plane]
    __global float *similar)            // [count]
{
  const size_t i = get_global_id(0) * W;
  FW m[5];
  for (int c = 0; c < 5; ++c) {
    __global const float *from = moments + (size_t)c * plane + i;
    m[c] = (FW)0.0f;
    for (int k = 0; k < SSIM_WINDOW; ++k) m[c] = m[c] + (FW)taps[k] * LOADF(from, k);
  }
  const FW ab = m[0] * m[1], aa = m[0] * m[0], bb = m[1] * m[1];
  const FW light = quotient((FW)2.0f * ab + (FW)SSIM_C1, aa + bb + (FW)SSIM_C1);
  const FW both = quotient((FW)2.0f * (m[4] - ab) + (FW)SSIM_C2, (m[2] - aa) + (m[3] - bb) + (FW)SSIM_C2);
  STOREF(light * both, similar, i);
}

// Gradient of SSIM by the picture a, for descents: a is a drawn view, b its target, both clamped to [0, 1], in three channels. Two
// kernels: slopes of every window's SSIM by its moments, and their windowed sums back to the pixels. A work-item has SPAN elements of
// a row; it sums along columns first, a few elements farther than that, and then along the row.
// A window is named by its last pixel, so that the sums back are windows that begin at a pixel; the window is symmetric. Windows that leave
// the picture have slopes of 0, and so do the rows and columns around those that the slopes are written to.

#ifdef GROUP
#define SPAN W
#else
#define SPAN ROW_SPAN
#endif
#define SPAN_VECTORS ((SPAN + SSIM_WINDOW - 1 + W - 1) / W)   // vectors of a span and of what its last windows reach

// Channel, row and first column of a work-item; nothing is left to do if the column is behind the row's end.
#define SPAN_OF(rows)                                          \
  const size_t e = get_global_id(0) * SPAN;                    \
  const uint x0 = (uint)(e % across), y = (uint)(e / across) % (rows), channel = (uint)(e / across) / (rows); \
  if (channel > 2 || x0 >= stride) return;                     \
  const uint end = min(x0 + (uint)SPAN, stride);

// clamp(x, 0, 1); NaN gives 0.
inline FW shown(FW x) { return smaller(larger(x, (FW)0.0f), (FW)1.0f); }

#if W == 1
#define LOADH(p, i) vload_half(i, p)
#else
#define LOADH(p, i) CAT(vload_half, W)(0, (p) + (i))
#endif

// What a window's SSIM gains by a change of its mean of a, of a a and of a b.
__kernel void dssim_slopes(
    const uint across,                  // stride, rounded up to whole spans
    const uint rows,                    // windows of a column: height - size + 1
    const uint columns,                 // windows of a row: width - size + 1
    const uint stride,                  // elements of a row, a multiple of 16
    const uint plane,                   // elements of a channel of the picture
    const uint wide,                    // elements of a plane of slopes: at least (height + size) stride
    const uint size,                    // of the window, odd
    __global const float *taps,         // [size]
    __global const float *image,        // [3, plane]
    __global const half *target,        // [3, plane]
    __global float *slopes)             // [3, 3, wide] of every channel, by the last pixel of a window
{
  SPAN_OF(rows)
  const size_t row = channel * (size_t)plane + y * (size_t)stride;
  // Moments of a, b, a a, b b and a b along the columns.
  float moments[5][SPAN_VECTORS * W];
  for (uint v = 0; v < SPAN + size - 1; v += W) {
    FW ma = (FW)0.0f, mb = (FW)0.0f, maa = (FW)0.0f, mbb = (FW)0.0f, mab = (FW)0.0f;
    // Windows that reach beyond the row have no slopes.
    if (x0 + v < stride)
      for (uint k = 0; k < size; ++k) {
        const size_t from = row + x0 + v + (size_t)k * stride;
        const FW va = shown(LOADF(image, from)), vb = shown(LOADH(target, from)), tap = (FW)taps[k];
        const FW ta = tap * va, tb = tap * vb;
        ma = ma + ta;
        mb = mb + tb;
        maa = maa + ta * va;
        mbb = mbb + tb * vb;
        mab = mab + ta * vb;
      }
    STOREF(ma, moments[0], v);
    STOREF(mb, moments[1], v);
    STOREF(maa, moments[2], v);
    STOREF(mbb, moments[3], v);
    STOREF(mab, moments[4], v);
  }
  __global float *to = slopes + channel * (size_t)(3 * wide) + (y + size - 1) * (size_t)stride + size - 1;
  for (uint x = x0; x < end; x += W) {
    FW m[5];
    for (int c = 0; c < 5; ++c) {
      m[c] = (FW)0.0f;
      for (uint k = 0; k < size; ++k) m[c] = m[c] + (FW)taps[k] * LOADF(moments[c], x - x0 + k);
    }
    const FW ab = m[0] * m[1], aa = m[0] * m[0], bb = m[1] * m[1];
    const FW means = aa + bb + (FW)SSIM_C1, variances = (m[2] - aa) + (m[3] - bb) + (FW)SSIM_C2;
    const FW light = quotient((FW)2.0f * ab + (FW)SSIM_C1, means);
    const FW both = quotient((FW)2.0f * (m[4] - ab) + (FW)SSIM_C2, variances);
    const FW by_mean = quotient(both * (m[1] - light * m[0]), means) + quotient(light * (both * m[0] - m[1]), variances);
    const IW inside = MASK((IW)(int)x + LANE_INDEX < (IW)(int)columns);
    STOREF(pick(inside, (FW)2.0f * by_mean, (FW)0.0f), to, x);
    STOREF(pick(inside, -quotient(light * both, variances), (FW)0.0f), to, wide + x);
    STOREF(pick(inside, quotient((FW)2.0f * light, variances), (FW)0.0f), to, 2 * (size_t)wide + x);
  }
}

// The slopes summed over all windows that hold a pixel: the gradient of all windows' SSIM, times `factor`, added to the residual. Pixels
// outside [0, 1] have none.
__kernel void dssim_residual(
    const uint across,
    const uint rows,                    // height
    const uint stride,
    const uint plane,
    const uint wide,
    const float factor,
    const uint size,
    __global const float *taps,
    __global const float *slopes,       // [3, 3, wide]
    __global const float *image,
    __global const half *target,
    __global float *residual)           // [3, plane]
{
  SPAN_OF(rows)
  float sums[3][SPAN_VECTORS * W];
  for (uint v = 0; v < SPAN + size - 1; v += W)
    for (int c = 0; c < 3; ++c) {
      __global const float *from = slopes + (3 * channel + c) * (size_t)wide + y * (size_t)stride + x0 + v;
      FW sum = (FW)0.0f;
      if (x0 + v < stride)
        for (uint k = 0; k < size; ++k) sum = sum + (FW)taps[k] * LOADF(from, (size_t)k * stride);
      STOREF(sum, sums[c], v);
    }
  for (uint x = x0; x < end; x += W) {
    FW by[3];
    for (int c = 0; c < 3; ++c) {
      by[c] = (FW)0.0f;
      for (uint k = 0; k < size; ++k) by[c] = by[c] + (FW)taps[k] * LOADF(sums[c], x - x0 + k);
    }
    const size_t i = channel * (size_t)plane + y * (size_t)stride + x;
    const FW a = LOADF(image, i), b = shown(LOADH(target, i));
    const FW slope = by[0] + (FW)2.0f * a * by[1] + b * by[2];
    STOREF(LOADF(residual, i) + pick(MASK(a >= (FW)0.0f) & MASK(a <= (FW)1.0f), (FW)factor * slope, (FW)0.0f), residual, i);
  }
}
