// Gradients of a view's squared error, from sums over its pixels to the stored values of every Gaussian.
// Twins: flexgs_edge.kernels.twins.backward

#define CAM(k) ((FW)camera[k])
#define GRADIENT_SUMS 9    // of blend with STATS 5
#define LN2 ((FW)(1.0f / LOG2_E))

// Stores into the rows that have a gradient; the other rows stay as they are.
#define KEEP(plane, value)                                         \
  {                                                                \
    __global float *at = gradient + (size_t)(plane) * s + i;       \
    STOREF(pick(seen, value, LOADF(at, 0)), at, 0);                \
  }

__kernel void project_backward(
    const uint count,                     // rows of this chunk
    const uint stride,
    const uint base,                      // row of the scene that the chunk starts at
    const uint degree,                    // SH degree of the chunk
    const int antialiased,
    const float wide,                     // rows with a larger deviation over their depth take shorter steps
    __global const float *camera,         // [32]
    __global const float *means,          // [3, stride]
    __global const float *log_scales,     // [3, stride]
    __global const float *quats,          // [4, stride]
    __global const float *logits,         // [stride]
    __global const float *sh_rest,        // [3 * K, stride]
    __global const uint *degrees,         // [stride] SH degree of each row: no gradient above it
    __global const float *records,        // [N, 16] of the view
    __global const long *sums,            // [N, 9] of blend_backward
    __global float *pace,                 // [stride] share of a whole step that a row takes; 0 where it has no gradient
    __global float *gradient)             // [14 + 3 K, stride]
{
  const size_t i = get_global_id(0) * W, s = stride;
  float lanes[GRADIENT_SUMS + 9][W];
  float seen_lanes[W];
  for (int l = 0; l < W; ++l) {
    const size_t row = base + i + l;
    const int there = i + l < count;
    int some = 0;
    for (int k = 0; k < GRADIENT_SUMS; ++k) {
      const long sum = there ? sums[row * GRADIENT_SUMS + k] : 0;
      some |= sum != 0;
      // Times minus two: the sums are of residuals, and the error is the sum of their squares.
      lanes[k][l] = convert_float(sum) * (float)(k < 4 ? -2.0f / FIXED_WEIGHT : -2.0f / FIXED_MOMENT);
    }
    // Rows that the view does not show have no record.
    for (int f = 0; f < 9; ++f) lanes[GRADIENT_SUMS + f][l] = some ? records[row * 16 + f] : 0.0f;
    seen_lanes[l] = some ? 1.0f : 0.0f;
  }
  const FW seen_row = LOADF(seen_lanes, 0);
  const IW seen = MASK(seen_row > (FW)0.0f);
  if (!ANY(seen)) {
    STOREF(seen_row, pace, i);
    return;
  }
#define SUM(k) LOADF(lanes[k], 0)
#define RECORD(f) LOADF(lanes[GRADIENT_SUMS + (f)], 0)

  // Colours: the constant, SH, and the direction on which SH depend.
  const FW px = LOADF(means, i), py = LOADF(means, s + i), pz = LOADF(means, 2 * s + i);
  FW dx = px - CAM(21), dy = py - CAM(22), dz = pz - CAM(23);
  const FW norm = quotient((FW)1.0f, sqrt(dot3(dx, dy, dz, dx, dy, dz)));
  dx = dx * norm;
  dy = dy * norm;
  dz = dz * norm;
  FW colour[3];
  for (int c = 0; c < 3; ++c) {
    // A colour that is clipped at zero has no gradient.
    colour[c] = pick(MASK(RECORD(6 + c) > (FW)0.0f), SUM(c), (FW)0.0f);
    KEEP(AT_DC + c, (FW)SH_C0 * colour[c]);
  }
  const uint bands = (degree + 1) * (degree + 1) - 1;
  FW tx = (FW)0.0f, ty = (FW)0.0f, tz = (FW)0.0f;
  if (degree) {
    const UW own = degrees_at(degrees, i);
#define ADD_GRADIENT(k, value)                                                                             \
    {                                                                                                      \
      const uint level = (k) < 3 ? 1 : (k) < 8 ? 2 : (k) < 15 ? 3 : 4;                                     \
      const FW basis = pick(MASK(own >= (UW)level), value, (FW)0.0f);                                      \
      for (int c = 0; c < 3; ++c) KEEP(AT_SH + c * bands + (k), basis * colour[c]);                        \
    }
    FOR_EACH_BASIS(degree, dx, dy, dz, ADD_GRADIENT)
#define ADD_SLOPE(k, sx, sy, sz)                                                                           \
    {                                                                                                      \
      const FW along = dot3(LOADF(sh_rest, (size_t)(k) * s + i), LOADF(sh_rest, (size_t)((k) + bands) * s + i), \
                            LOADF(sh_rest, (size_t)((k) + 2 * bands) * s + i), colour[0], colour[1], colour[2]); \
      tx = fma(along, sx, tx);                                                                             \
      ty = fma(along, sy, ty);                                                                             \
      tz = fma(along, sz, tz);                                                                             \
    }
    FOR_EACH_SLOPE(degree, dx, dy, dz, ADD_SLOPE)
    // Only the part across the direction turns it.
    const FW along = dot3(dx, dy, dz, tx, ty, tz);
    tx = fma(-along, dx, tx) * norm;
    ty = fma(-along, dy, ty) * norm;
    tz = fma(-along, dz, tz) * norm;
  }

  // Axes, and the projection of the factor R diag(exp s), in the written forms of activate.cl and project.cl.
  const FW s0 = fexp2(LOADF(log_scales, i) * (FW)LOG2_E);
  const FW s1 = fexp2(LOADF(log_scales, s + i) * (FW)LOG2_E);
  const FW s2 = fexp2(LOADF(log_scales, 2 * s + i) * (FW)LOG2_E);
  FW qw = LOADF(quats, i), qx = LOADF(quats, s + i), qy = LOADF(quats, 2 * s + i), qz = LOADF(quats, 3 * s + i);
  const FW big = fmax(fmax(fabs(qw), fabs(qx)), fmax(fabs(qy), fabs(qz)));
  qw = quotient(qw, big);
  qx = quotient(qx, big);
  qy = quotient(qy, big);
  qz = quotient(qz, big);
  const FW inv = quotient((FW)1.0f, sqrt(fma(qz, qz, fma(qy, qy, fma(qx, qx, qw * qw)))));
  qw = qw * inv;
  qx = qx * inv;
  qy = qy * inv;
  qz = qz * inv;
  const FW r00 = fma((FW)-2.0f, fma(qz, qz, qy * qy), (FW)1.0f), r01 = (FW)2.0f * fma(qx, qy, -(qw * qz));
  const FW r02 = (FW)2.0f * fma(qx, qz, qw * qy), r10 = (FW)2.0f * fma(qx, qy, qw * qz);
  const FW r11 = fma((FW)-2.0f, fma(qz, qz, qx * qx), (FW)1.0f), r12 = (FW)2.0f * fma(qy, qz, -(qw * qx));
  const FW r20 = (FW)2.0f * fma(qx, qz, -(qw * qy)), r21 = (FW)2.0f * fma(qy, qz, qw * qx);
  const FW r22 = fma((FW)-2.0f, fma(qy, qy, qx * qx), (FW)1.0f);

  const FW z = fma(CAM(8), pz, fma(CAM(6), px, CAM(7) * py)) + CAM(11);
  const FW x = fma(CAM(2), pz, fma(CAM(0), px, CAM(1) * py)) + CAM(9);
  const FW y = fma(CAM(5), pz, fma(CAM(3), px, CAM(4) * py)) + CAM(10);
  const FW iz = quotient((FW)1.0f, z), u = x * iz, v = y * iz;
  // A turn or growth of a splat that fills the view changes all of it, so it goes in smaller steps.
  const FW size = larger(larger(s0, s1), s2) * iz;
  STOREF(pick(seen, pick(MASK(size > (FW)wide), quotient((FW)wide, size), (FW)1.0f), (FW)0.0f), pace, i);
  const FW uc = fmin(fmax(u, CAM(17)), CAM(18)), vc = fmin(fmax(v, CAM(19)), CAM(20));
  const FW j00 = CAM(12) * iz, j02 = -(j00 * uc), j11 = CAM(13) * iz, j12 = -(j11 * vc);
  const FW t00 = fma(j02, CAM(6), j00 * CAM(0)), t01 = fma(j02, CAM(7), j00 * CAM(1)), t02 = fma(j02, CAM(8), j00 * CAM(2));
  const FW t10 = fma(j12, CAM(6), j11 * CAM(3)), t11 = fma(j12, CAM(7), j11 * CAM(4)), t12 = fma(j12, CAM(8), j11 * CAM(5));
  // Rows of the projection in the Gaussian's own axes; then they are multiplied by its standard deviations.
  const FW h00 = dot3(t00, t01, t02, r00, r10, r20), h01 = dot3(t00, t01, t02, r01, r11, r21), h02 = dot3(t00, t01, t02, r02, r12, r22);
  const FW h10 = dot3(t10, t11, t12, r00, r10, r20), h11 = dot3(t10, t11, t12, r01, r11, r21), h12 = dot3(t10, t11, t12, r02, r12, r22);
  const FW g00 = h00 * s0, g01 = h01 * s1, g02 = h02 * s2, g10 = h10 * s0, g11 = h11 * s1, g12 = h12 * s2;

  // With the second moments S and the conic A, the gradient of the 2D covariance is A S A / 2, and that of the rows g is A S A g.
  const FW ca = RECORD(2) * ((FW)2.0f * LN2), cb = RECORD(3) * LN2, cc = RECORD(4) * ((FW)2.0f * LN2);
  const FW sxx = SUM(6), sxy = SUM(7), syy = SUM(8);
  const FW p00 = fma(ca, sxx, cb * sxy), p01 = fma(ca, sxy, cb * syy), p10 = fma(cb, sxx, cc * sxy), p11 = fma(cb, sxy, cc * syy);
  const FW u00 = fma(p00, ca, p01 * cb), u01 = fma(p00, cb, p01 * cc), u11 = fma(p10, cb, p11 * cc);
  FW v00 = fma(u00, g00, u01 * g10), v01 = fma(u00, g01, u01 * g11), v02 = fma(u00, g02, u01 * g12);
  FW v10 = fma(u01, g00, u11 * g10), v11 = fma(u01, g01, u11 * g11), v12 = fma(u01, g02, u11 * g12);
  const FW slope = SUM(3);
  if (antialiased) {
    // log of the opacity's factor: half the difference of the logs of the areas before and after the dilation.
    const FW nx = fma(g01, g12, -(g02 * g11)), ny = fma(g02, g10, -(g00 * g12)), nz = fma(g00, g11, -(g01 * g10));
    const FW before = dot3(nx, ny, nz, nx, ny, nz);
    const FW share = pick(MASK(before > (FW)FACTOR_MIN), quotient(slope, before), (FW)0.0f);
    v00 = fma(share, fma(g11, nz, -(g12 * ny)), fma(-slope, fma(ca, g00, cb * g10), v00));
    v01 = fma(share, fma(g12, nx, -(g10 * nz)), fma(-slope, fma(ca, g01, cb * g11), v01));
    v02 = fma(share, fma(g10, ny, -(g11 * nx)), fma(-slope, fma(ca, g02, cb * g12), v02));
    v10 = fma(share, fma(ny, g02, -(nz * g01)), fma(-slope, fma(cb, g00, cc * g10), v10));
    v11 = fma(share, fma(nz, g00, -(nx * g02)), fma(-slope, fma(cb, g01, cc * g11), v11));
    v12 = fma(share, fma(nx, g01, -(ny * g00)), fma(-slope, fma(cb, g02, cc * g12), v12));
  }
  KEEP(AT_SCALE, fma(v00, g00, v10 * g10));
  KEEP(AT_SCALE + 1, fma(v01, g01, v11 * g11));
  KEEP(AT_SCALE + 2, fma(v02, g02, v12 * g12));

  // Small turns about the Gaussian's own axes are the skew part of h v s. They become changes of the quaternion, of any norm.
  v00 = v00 * s0, v01 = v01 * s1, v02 = v02 * s2, v10 = v10 * s0, v11 = v11 * s1, v12 = v12 * s2;
  const FW turn_x = fma(h02, v01, h12 * v11) - fma(h01, v02, h11 * v12);
  const FW turn_y = fma(h00, v02, h10 * v12) - fma(h02, v00, h12 * v10);
  const FW turn_z = fma(h01, v00, h11 * v10) - fma(h00, v01, h10 * v11);
  const FW twice = (FW)2.0f * quotient(inv, big);
  KEEP(AT_QUAT, -(twice * dot3(qx, qy, qz, turn_x, turn_y, turn_z)));
  KEEP(AT_QUAT + 1, twice * dot3(qw, qy, -qz, turn_x, turn_z, turn_y));
  KEEP(AT_QUAT + 2, twice * dot3(qw, qz, -qx, turn_y, turn_x, turn_z));
  KEEP(AT_QUAT + 3, twice * dot3(qw, qx, -qy, turn_z, turn_y, turn_x));

  const FW opacity = quotient((FW)1.0f, (FW)1.0f + fexp2(LOADF(logits, i) * (FW)-LOG2_E));
  KEEP(AT_LOGIT, slope * ((FW)1.0f - opacity));

  // From the projection's rows to camera space: through the centre, and through the Jacobian unless it is clamped.
  const FW w00 = dot3(r00, r01, r02, v00, v01, v02), w01 = dot3(r10, r11, r12, v00, v01, v02), w02 = dot3(r20, r21, r22, v00, v01, v02);
  const FW w10 = dot3(r00, r01, r02, v10, v11, v12), w11 = dot3(r10, r11, r12, v10, v11, v12), w12 = dot3(r20, r21, r22, v10, v11, v12);
  const FW e00 = dot3(w00, w01, w02, CAM(0), CAM(1), CAM(2)), e02 = dot3(w00, w01, w02, CAM(6), CAM(7), CAM(8));
  const FW e11 = dot3(w10, w11, w12, CAM(3), CAM(4), CAM(5)), e12 = dot3(w10, w11, w12, CAM(6), CAM(7), CAM(8));
  const FW mx = fma(ca, SUM(4), cb * SUM(5)), my = fma(cb, SUM(4), cc * SUM(5));
  FW du = CAM(12) * mx, dv = CAM(13) * my;
  du = du - pick(MASK(uc == u), j00 * e02, (FW)0.0f);
  dv = dv - pick(MASK(vc == v), j11 * e12, (FW)0.0f);
  const FW deep = fma(CAM(12), fma(-uc, e02, e00), CAM(13) * fma(-vc, e12, e11));
  const FW cx = du * iz, cy = dv * iz, cz = -(fma(iz, deep, fma(u, du, v * dv)) * iz);
  KEEP(0, dot3(CAM(0), CAM(3), CAM(6), cx, cy, cz) + tx);
  KEEP(1, dot3(CAM(1), CAM(4), CAM(7), cx, cy, cz) + ty);
  KEEP(2, dot3(CAM(2), CAM(5), CAM(8), cx, cy, cz) + tz);
}
