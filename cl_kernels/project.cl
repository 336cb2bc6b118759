// Projects the blocks of a chunk that a view may show: splat records, depth keys, and the number of tiles that each splat may touch.
// Twin: flexgs_edge.kernels.twins.project

// The camera, 32 floats (see also sh.clh): R row-major 0-8, t 9-11, fx fy cx cy 12-15, near 16, Jacobian clamp x lo hi, y lo hi 17-20,
// position 21-23, width height 24-25, dilation 26.
#define CAM(k) ((FW)camera[k])

// A pixel position clamped to a little beyond the picture, so that `round_up` and `round_down` are exact. Tiles are clamped later.
inline FW near_image(FW at, FW size) { return smaller(larger(at, (FW)(-2.0f * TILE)), size + (FW)(2.0f * TILE)); }

__kernel void project(
    const uint count,                       // rows of this part of the view
    const uint stride,                      // elements of a plane, a multiple of 16
    const uint base,                        // row of the view that the part starts at
    const uint first,                       // place of its first block in `blocks`
    const int degree,                       // SH degree of the chunk
    const int antialiased,                  // 1: opacity times sqrt(det before / det after the dilation)
    __global const uint *blocks,            // blocks of the chunk, ascending
    __global const float *camera,           // [32]
    __global const float *means,            // [3, stride] scene units, relative to the origin
    __global const float *cov,              // [6, stride] the covariance; antialiased: its factor (activate.cl)
    __global const float *log2_opacity,     // [stride]
    __global const float *sh_dc,            // [3, stride]
    __global const float *sh_rest,          // [3 * K, stride]
    __global float *records,                // [N, 16] splats, see below
    __global uint *keys,                    // [N] depth bits, CULLED where not shown
    __global uint *bounds)                  // [N] tiles of the splat's bounding box
{
  const size_t n = get_global_id(0) * W;
  if (n >= count) return;
  const size_t s = stride, i = row_of(blocks, first, n);

  FW px = LOADF(means, i), py = LOADF(means, s + i), pz = LOADF(means, 2 * s + i);
  FW z = fma(CAM(8), pz, fma(CAM(6), px, CAM(7) * py)) + CAM(11);
  FW level = LOADF(log2_opacity, i);
  IW shown = MASK(z > CAM(16)) & MASK(level > (FW)-1e30f);
  shown &= MASK((LANE_INDEX + (IW)(int)n) < (IW)(int)count);

  FW x = fma(CAM(2), pz, fma(CAM(0), px, CAM(1) * py)) + CAM(9);
  FW y = fma(CAM(5), pz, fma(CAM(3), px, CAM(4) * py)) + CAM(10);
  FW iz = quotient((FW)1.0f, z);
  FW u = x * iz, v = y * iz;
  FW mx = fma(CAM(12), u, CAM(14)), my = fma(CAM(13), v, CAM(15));
  FW uc = smaller(larger(u, CAM(17)), CAM(18)), vc = smaller(larger(v, CAM(19)), CAM(20));
  FW j00 = CAM(12) * iz, j02 = -(j00 * uc);
  FW j11 = CAM(13) * iz, j12 = -(j11 * vc);
  FW t00 = fma(j02, CAM(6), j00 * CAM(0)), t01 = fma(j02, CAM(7), j00 * CAM(1)), t02 = fma(j02, CAM(8), j00 * CAM(2));
  FW t10 = fma(j12, CAM(6), j11 * CAM(3)), t11 = fma(j12, CAM(7), j11 * CAM(4)), t12 = fma(j12, CAM(8), j11 * CAM(5));

  FW cxx = LOADF(cov, i), cxy = LOADF(cov, s + i), cxz = LOADF(cov, 2 * s + i);
  FW cyy = LOADF(cov, 3 * s + i), cyz = LOADF(cov, 4 * s + i), czz = LOADF(cov, 5 * s + i);
  FW a, b, c, det;
  if (antialiased) {
    // Rows of projection times factor. Their cross product is the area before the dilation. Computed from a, b and c instead, the
    // area of a needle would be nothing but rounding.
    FW g00 = dot3(cxx, cxy, cxz, t00, t01, t02), g01 = fma(cyz, t02, cyy * t01), g02 = czz * t02;
    FW g10 = dot3(cxx, cxy, cxz, t10, t11, t12), g11 = fma(cyz, t12, cyy * t11), g12 = czz * t12;
    FW nx = fma(g01, g12, -(g02 * g11)), ny = fma(g02, g10, -(g00 * g12)), nz = fma(g00, g11, -(g01 * g10));
    FW before = dot3(nx, ny, nz, nx, ny, nz);
    a = dot3(g00, g01, g02, g00, g01, g02);
    b = dot3(g00, g01, g02, g10, g11, g12);
    c = dot3(g10, g11, g12, g10, g11, g12);
    det = before + fma(a + c, CAM(26), CAM(26) * CAM(26));
    a += CAM(26);
    c += CAM(26);
    FW share = quotient(before, det);  // at most 1: the sum above rounds to at least `before`
    shown &= MASK(share >= (FW)SHARE_MIN);
    level = fma((FW)0.5f, flog2(larger(share, (FW)SHARE_MIN)), level);
    shown &= MASK(level >= (FW)-(LOG2_255 + EXTENT_SLACK));
  } else {
    FW v0 = dot3(cxx, cxy, cxz, t00, t01, t02);
    FW v1 = dot3(cxy, cyy, cyz, t00, t01, t02);
    FW v2 = dot3(cxz, cyz, czz, t00, t01, t02);
    a = dot3(t00, t01, t02, v0, v1, v2) + CAM(26);
    b = dot3(t10, t11, t12, v0, v1, v2);
    v0 = dot3(cxx, cxy, cxz, t10, t11, t12);
    v1 = dot3(cxy, cyy, cyz, t10, t11, t12);
    v2 = dot3(cxz, cyz, czz, t10, t11, t12);
    c = dot3(t10, t11, t12, v0, v1, v2) + CAM(26);
    // ac - b^2 with the rounding error of b^2 added back, since plain float32 loses needles here.
    FW bb = b * b;
    det = fma(a, c, -bb) + fma(-b, b, bb);
  }

  FW level2 = (level + (FW)(LOG2_255 + EXTENT_SLACK)) * (FW)(2.0f / LOG2_E);  // the ellipse's q, natural units
  FW t2 = larger(level2, (FW)0.0f);
  FW half_width = sqrt(t2 * a), half_height = sqrt(t2 * c);
  const float width_pixels = camera[24], height_pixels = camera[25];
  const FW width = (FW)width_pixels, height = (FW)height_pixels;
  // Written so that NaN and infinity fail all tests.
  shown &= MASK(det > (FW)0.0f) & MASK(det < (FW)INFINITY) & MASK(a < (FW)INFINITY) & MASK(c < (FW)INFINITY);
  shown &= MASK(mx + half_width >= (FW)-1.0f) & MASK(mx - half_width <= width);
  shown &= MASK(my + half_height >= (FW)-1.0f) & MASK(my - half_height <= height);

  FW inv = quotient((FW)1.0f, det);
  FW k = inv * (FW)(0.5f * LOG2_E);  // exponents are powers of two
  FW out[16];
  out[0] = mx;
  out[1] = my;
  out[2] = c * k;
  out[3] = -(b + b) * k;
  out[4] = a * k;
  out[5] = level;
  // Numbers for the tile lists: x of the ellipse's right end, its half height, axis slope b/c, 1/c, det/c and level; then its only tile.
  FW ic = quotient((FW)1.0f, c);
  out[9] = quotient(b, a) * half_width;
  out[10] = half_height;
  out[11] = b * ic;
  out[12] = ic;
  out[13] = det * ic;
  out[14] = t2;

  // Tiles of the bounding box, inclusive: twice the slack of the spans in tiles.cl, since this sets the size of the pair buffer.
  FW sx = (FW)2.0f * fma(half_width, (FW)SPAN_SLACK_RELATIVE, (FW)SPAN_SLACK);
  FW sy = fma(half_height, (FW)SPAN_SLACK_RELATIVE, (FW)SPAN_SLACK);
  FW x0 = round_down(round_up(near_image(mx - half_width - sx, width)) * (FW)(1.0f / TILE));
  FW x1 = round_down(round_down(near_image(mx + half_width + sx, width)) * (FW)(1.0f / TILE));
  FW y0 = round_down(round_up(near_image(my - half_height - sy, height)) * (FW)(1.0f / TILE));
  FW y1 = round_down(round_down(near_image(my + half_height + sy, height)) * (FW)(1.0f / TILE));
  FW last_x = round_down((width - (FW)1.0f) * (FW)(1.0f / TILE)), last_y = round_down((height - (FW)1.0f) * (FW)(1.0f / TILE));
  x0 = larger(x0, (FW)0.0f);
  y0 = larger(y0, (FW)0.0f);
  x1 = smaller(x1, last_x);
  y1 = smaller(y1, last_y);
  shown &= MASK(x1 >= x0) & MASK(y1 >= y0);
  FW tiles = (x1 - x0 + (FW)1.0f) * (y1 - y0 + (FW)1.0f);

  // Most splats of a large scene lie in one tile. Their blocks in it are found here, for W splats at a time, and kept beside the tile's
  // number. A splat between all pixels has no blocks: it is not shown.
  const int tiles_x = ((int)width_pixels + TILE - 1) / TILE, tiles_y = ((int)height_pixels + TILE - 1) / TILE;
  IW only = shown & MASK(tiles == (FW)1.0f) & (IW)(tiles_x * tiles_y <= MOST_NUMBERED ? -1 : 0);
  out[15] = (FW)0.0f;
  if (ANY(only)) {
    const IW column = whole(x0), row = whole(y0);
    IW mask = (IW)0;
    for (int band = 0; band < 4; ++band) {
      IW first, last;
      block_spans(row * (IW)4 + (IW)band, mx, my, out[9], half_height, out[11], ic, out[13], t2, width_pixels, &first, &last);
      first -= column * (IW)4;
      last -= column * (IW)4;
      mask |= row_mask(picki(MASK(first > (IW)0), first, (IW)0), picki(MASK(last < (IW)3), last, (IW)3)) << (IW)(4 * band);
    }
    out[15] = AS_F(picki(only, ((row * (IW)tiles_x + column) << (IW)16) | mask, (IW)0));
    shown &= ~only | MASK(mask != (IW)0);
  }

  if (ANY(shown)) {
    FW dx, dy, dz;
    view_direction(camera, px, py, pz, &dx, &dy, &dz);
    FW basis[24];
    FOR_EACH_BASIS(degree, dx, dy, dz, KEEP_BASIS)
    const int all = (degree + 1) * (degree + 1) - 1;
    for (int channel = 0; channel < 3; ++channel) {
      FW colour = (FW)SH_C0 * LOADF(sh_dc, channel * s + i);
      for (int k = 0; k < all; ++k) colour = fma(basis[k], LOADF(sh_rest, (size_t)(channel * all + k) * s + i), colour);
      out[6 + channel] = larger(colour + (FW)0.5f, (FW)0.0f);
    }
  } else {
    out[6] = out[7] = out[8] = (FW)0.0f;
  }

  float lanes[16][W];
  float key_lanes[W], bound_lanes[W];
  int shown_lanes[W];
  for (int f = 0; f < 16; ++f) STOREF(out[f], lanes[f], 0);
  STOREF(z, key_lanes, 0);
  STOREF(tiles, bound_lanes, 0);
  STOREI(shown, shown_lanes, 0);
  for (int l = 0; l < W && n + l < count; ++l) {
    const size_t row = base + n + l;
    keys[row] = shown_lanes[l] ? as_uint(key_lanes[l]) : (uint)CULLED;
    bounds[row] = shown_lanes[l] ? (uint)bound_lanes[l] : 0u;
    if (shown_lanes[l])
      for (int f = 0; f < 16; ++f) records[row * 16 + f] = lanes[f][l];
  }
}
