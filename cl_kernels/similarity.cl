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
  const FW light = ((FW)2.0f * ab + (FW)SSIM_C1) / (aa + bb + (FW)SSIM_C1);
  const FW both = ((FW)2.0f * (m[4] - ab) + (FW)SSIM_C2) / ((m[2] - aa) + (m[3] - bb) + (FW)SSIM_C2);
  STOREF(light * both, similar, i);
}
