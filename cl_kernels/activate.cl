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
  activate_rows(get_global_id(0) * W, stride, antialiased, log_scales, quats, logits, cov, log2_opacity);
}
