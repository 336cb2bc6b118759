// Stored attributes -> the 3D covariance (or its factor) and log2 of the opacity. Runs once a scene, since no view changes them.
// Twin: flexgs_edge.kernels.twins.activate

__kernel void activate(
    const uint stride,                    // elements of a plane, a multiple of 16
    const int antialiased,                // 1: the factor of the covariance, which keeps the areas of needles and flat splats
    __global const float *log_scales,     // [3, stride] natural log, scene units
    __global const float *quats,          // [4, stride] w x y z, any norm
    __global const float *logits,         // [stride]
    __global float *cov,                  // [6, stride] xx xy xz yy yz zz, scene units^2; the factor F in units: cov = F F^T,
                                          // F lower triangular, columns xx yx zx, yy zy, zz
    __global float *log2_opacity)         // [stride], -inf where the opacity is below ALPHA_MIN
{
  const size_t i = get_global_id(0) * W;
  FW s0 = fexp2(LOADF(log_scales, i) * (FW)LOG2_E);
  FW s1 = fexp2(LOADF(log_scales, stride + i) * (FW)LOG2_E);
  FW s2 = fexp2(LOADF(log_scales, 2 * (size_t)stride + i) * (FW)LOG2_E);

  FW w = LOADF(quats, i), x = LOADF(quats, stride + i);
  FW y = LOADF(quats, 2 * (size_t)stride + i), z = LOADF(quats, 3 * (size_t)stride + i);
  // Divide by the largest component first, since squares of tiny or huge quaternions would leave float32's range.
  FW big = fmax(fmax(fabs(w), fabs(x)), fmax(fabs(y), fabs(z)));
  w = quotient(w, big);
  x = quotient(x, big);
  y = quotient(y, big);
  z = quotient(z, big);
  FW inv = quotient((FW)1.0f, sqrt(fma(z, z, fma(y, y, fma(x, x, w * w)))));
  w = w * inv;
  x = x * inv;
  y = y * inv;
  z = z * inv;

  FW m00 = fma((FW)-2.0f, fma(z, z, y * y), (FW)1.0f) * s0;
  FW m01 = (FW)2.0f * fma(x, y, -(w * z)) * s1;
  FW m02 = (FW)2.0f * fma(x, z, w * y) * s2;
  FW m10 = (FW)2.0f * fma(x, y, w * z) * s0;
  FW m11 = fma((FW)-2.0f, fma(z, z, x * x), (FW)1.0f) * s1;
  FW m12 = (FW)2.0f * fma(y, z, -(w * x)) * s2;
  FW m20 = (FW)2.0f * fma(x, z, -(w * y)) * s0;
  FW m21 = (FW)2.0f * fma(y, z, w * x) * s1;
  FW m22 = fma((FW)-2.0f, fma(y, y, x * x), (FW)1.0f) * s2;

  FW xx = dot3(m00, m01, m02, m00, m01, m02), xy, xz, yy, yz, zz;
  if (antialiased) {
    // Modified Gram-Schmidt on the rows: the factor is that of a matrix within a few ulp of M, whatever its rank. A row of length
    // zero has no direction to subtract. The limit is far above the numbers that some devices flush to zero.
    FW inv0 = pick(MASK(xx > (FW)FACTOR_MIN), quotient((FW)1.0f, sqrt(xx)), (FW)0.0f);
    FW ux = m00 * inv0, uy = m01 * inv0, uz = m02 * inv0;
    xx = sqrt(xx);
    xy = dot3(m10, m11, m12, ux, uy, uz);
    xz = dot3(m20, m21, m22, ux, uy, uz);
    m10 = fma(-xy, ux, m10), m11 = fma(-xy, uy, m11), m12 = fma(-xy, uz, m12);
    m20 = fma(-xz, ux, m20), m21 = fma(-xz, uy, m21), m22 = fma(-xz, uz, m22);
    yy = dot3(m10, m11, m12, m10, m11, m12);
    FW inv1 = pick(MASK(yy > (FW)FACTOR_MIN), quotient((FW)1.0f, sqrt(yy)), (FW)0.0f);
    ux = m10 * inv1, uy = m11 * inv1, uz = m12 * inv1;
    yy = sqrt(yy);
    yz = dot3(m20, m21, m22, ux, uy, uz);
    m20 = fma(-yz, ux, m20), m21 = fma(-yz, uy, m21), m22 = fma(-yz, uz, m22);
    zz = sqrt(dot3(m20, m21, m22, m20, m21, m22));
  } else {
    xy = dot3(m00, m01, m02, m10, m11, m12);
    xz = dot3(m00, m01, m02, m20, m21, m22);
    yy = dot3(m10, m11, m12, m10, m11, m12);
    yz = dot3(m10, m11, m12, m20, m21, m22);
    zz = dot3(m20, m21, m22, m20, m21, m22);
  }
  STOREF(xx, cov, i);
  STOREF(xy, cov, (size_t)stride + i);
  STOREF(xz, cov, 2 * (size_t)stride + i);
  STOREF(yy, cov, 3 * (size_t)stride + i);
  STOREF(yz, cov, 4 * (size_t)stride + i);
  STOREF(zz, cov, 5 * (size_t)stride + i);

  FW opacity = quotient((FW)1.0f, (FW)1.0f + fexp2(LOADF(logits, i) * (FW)-LOG2_E));
  FW level = flog2(fmax(opacity, (FW)ALPHA_MIN));
  STOREF(pick(MASK(opacity >= (FW)ALPHA_MIN), level, (FW)-INFINITY), log2_opacity, i);
}
