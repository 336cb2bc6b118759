// SSIM (Wang et al. 2004) of two one-channel images: windowed moments along columns, then along rows.
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

// Gradient of SSIM by the picture a, for descents: a is one channel of a drawn view, b that of its target, both clamped to [0, 1]. Four
// kernels: moments along columns, slopes of every window's SSIM by its moments, and their windowed sums back to the pixels.
// A window is named by its last pixel, so that the sums back are windows that begin at a pixel; the window is symmetric. Windows that leave
// the picture have slopes of 0, and so do the first columns of a row, which the last sums of the row before it read.

// clamp(x, 0, 1); NaN gives 0.
inline FW shown(FW x) { return smaller(larger(x, (FW)0.0f), (FW)1.0f); }

#if W == 1
#define LOADH(p, i) vload_half(i, p)
#else
#define LOADH(p, i) CAT(vload_half, W)(0, (p) + (i))
#endif

// Moments of a, b, a a, b b and a b, windowed along the columns, for every element whose window is inside the picture.
__kernel void dssim_columns(
    const uint count,                   // (height - size + 1) stride; items beyond it do nothing, as below
    const uint first,                   // element that the channel begins at
    const uint stride,                  // elements of a row, a multiple of 16
    const uint plane,                   // elements from one plane of moments to the next
    const uint size,                    // of the window, odd
    __global const float *taps,         // [size]
    __global const float *image,        // [3, rows, stride]
    __global const half *target,        // the same
    __global float *moments)            // [5, plane]
{
  const size_t i = get_global_id(0) * W;
  if (i >= count) return;
  FW ma = (FW)0.0f, mb = (FW)0.0f, maa = (FW)0.0f, mbb = (FW)0.0f, mab = (FW)0.0f;
  for (uint k = 0; k < size; ++k) {
    const size_t from = first + i + (size_t)k * stride;
    const FW va = shown(LOADF(image, from)), vb = shown(LOADH(target, from)), tap = (FW)taps[k];
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

// The moments windowed along the rows, and what a window's SSIM gains by a change of its mean of a, of a a and of a b.
__kernel void dssim_slopes(
    const uint count,
    const uint stride,
    const uint columns,                 // windows of a row: width - size + 1
    const uint plane,                   // at least count + size - 1
    const uint wide,                    // elements from one plane of slopes to the next
    const uint size,
    __global const float *taps,
    __global const float *moments,      // [5, plane]
    __global float *slopes)             // [3, wide], by the last pixel of a window
{
  const size_t i = get_global_id(0) * W;
  if (i >= count) return;
  FW m[5];
  for (int c = 0; c < 5; ++c) {
    __global const float *from = moments + (size_t)c * plane + i;
    m[c] = (FW)0.0f;
    for (uint k = 0; k < size; ++k) m[c] = m[c] + (FW)taps[k] * LOADF(from, k);
  }
  const FW ab = m[0] * m[1], aa = m[0] * m[0], bb = m[1] * m[1];
  const FW means = aa + bb + (FW)SSIM_C1, variances = (m[2] - aa) + (m[3] - bb) + (FW)SSIM_C2;
  const FW light = quotient((FW)2.0f * ab + (FW)SSIM_C1, means);
  const FW both = quotient((FW)2.0f * (m[4] - ab) + (FW)SSIM_C2, variances);
  const FW by_mean = quotient(both * (m[1] - light * m[0]), means) + quotient(light * (both * m[0] - m[1]), variances);
  const IW inside = MASK((IW)(int)(i % stride) + LANE_INDEX < (IW)(int)columns);
  __global float *to = slopes + i + (size_t)(size - 1) * (stride + 1);
  STOREF(pick(inside, (FW)2.0f * by_mean, (FW)0.0f), to, 0);
  STOREF(pick(inside, -quotient(light * both, variances), (FW)0.0f), to, wide);
  STOREF(pick(inside, quotient((FW)2.0f * light, variances), (FW)0.0f), to, 2 * (size_t)wide);
}

// The slopes summed along the columns, over all windows that hold a pixel.
__kernel void dssim_columns_back(
    const uint count,                   // (height + 1) stride: the last sums along rows read the row below
    const uint stride,
    const uint plane,
    const uint wide,                    // at least count + (size - 1) stride
    const uint size,
    __global const float *taps,
    __global const float *slopes,       // [3, wide]
    __global float *sums)               // [3, plane] of the moments' array
{
  const size_t i = get_global_id(0) * W;
  if (i >= count) return;
  for (int c = 0; c < 3; ++c) {
    __global const float *from = slopes + (size_t)c * wide + i;
    FW sum = (FW)0.0f;
    for (uint k = 0; k < size; ++k) sum = sum + (FW)taps[k] * LOADF(from, (size_t)k * stride);
    STOREF(sum, sums, i + (size_t)c * plane);
  }
}

// The sums along the rows too, and the gradient of all windows' SSIM, times `factor`, added to the residual. Pixels outside [0, 1] have none.
__kernel void dssim_residual(
    const uint count,                   // height stride
    const uint first,
    const uint plane,                   // at least count + size - 1
    const float factor,
    const uint size,
    __global const float *taps,
    __global const float *sums,         // [3, plane]
    __global const float *image,
    __global const half *target,
    __global float *residual)           // [3, rows, stride]
{
  const size_t i = get_global_id(0) * W;
  if (i >= count) return;
  FW by[3];
  for (int c = 0; c < 3; ++c) {
    __global const float *from = sums + (size_t)c * plane + i;
    by[c] = (FW)0.0f;
    for (uint k = 0; k < size; ++k) by[c] = by[c] + (FW)taps[k] * LOADF(from, k);
  }
  const FW a = LOADF(image, first + i), b = shown(LOADH(target, first + i));
  const FW slope = by[0] + (FW)2.0f * a * by[1] + b * by[2];
  __global float *to = residual + first + i;
  STOREF(LOADF(to, 0) + pick(MASK(a >= (FW)0.0f) & MASK(a <= (FW)1.0f), (FW)factor * slope, (FW)0.0f), to, 0);
}
