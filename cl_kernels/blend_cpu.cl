// Front-to-back blending of one tile by one work-item: explicit vectors over 4x4 blocks, no __local, no barriers.
// On CPUs this is far faster than a work-item for each pixel. It gives the bits of blend_gpu.cl at every W.
// Twin: flexgs_edge.kernels.twins.blend
//
// A pixel that has ended keeps its transmittance with the sign flipped. Then T (1 - alpha) < TRANSMITTANCE_MIN holds for every
// later splat, and no other state is needed.

#define BLOCK_VECTORS (16 / W)   // vectors of a 4x4 block
#define BLOCKS 16                // blocks of a tile
#define RETIRE_EVERY 16          // splats between two looks for blocks whose pixels have all ended

#if !defined(STATS) || !defined(BLEND)
#error "BLEND (the kernel's name) and STATS (0: image only, 1: hits and weights, 2: removal costs, 3: residual, 4: residual and removal costs, 5: gradients) must be defined"
#endif

#ifndef BLEND_HELPERS
#define BLEND_HELPERS
// Lane l of vector v is pixel (l + v W) of the block, row by row.
inline FW lane_x(void) { return TO_F(LANE_INDEX & (IW)3); }
inline FW lane_y(int v) { return TO_F((LANE_INDEX + (IW)(v * W)) >> 2); }

#if W == 1
inline FW lane_x_at(int v) { return (float)(v & 3); }
#else
inline FW lane_x_at(int v) { return lane_x(); }
#endif

inline int any_alive(FW t) {
#if W == 16
  const long8 bits = as_long8(AS_I(t));
  // Sign bits of both halves of each long; a clear sign bit means that the pixel is still open.
  const long8 open = ~bits & (long8)(0x8000000080000000UL);
  const long4 a = open.lo | open.hi;
  const long2 b = a.lo | a.hi;
  return (b.lo | b.hi) != 0;
#else
  return ANY(MASK(t > (FW)0.0f));
#endif
}

#define SUMS (STATS == 1 ? 1 : STATS == 2 ? 2 : STATS == 3 ? 4 : STATS == 4 ? 6 : 9)
#if defined(cl_khr_int64_base_atomics) && defined(__ENDIAN_LITTLE__)
#pragma OPENCL EXTENSION cl_khr_int64_base_atomics : enable
// Adds to the words in one step, where 64-bit atomics exist.
inline void add_sum(__global uint *words, float value, float scale, float largest) {
  atom_add((volatile __global long *)words, (long)clamp(value * scale, -largest, largest));
}
#else
#define add_sum add_fixed
#endif
#define ADD_SUM(k, v, scale) add_sum(sums + (size_t)pair.x * (2 * SUMS) + 2 * (k), tree_sum(v), scale, largest)

// Sums the 16 lanes of a block by a fixed pairwise tree: l + (l + 8), then + 4, + 2, + 1.
#if W == 16
#define FOLD(v) const CAT(LANE_T, 8) h = v[0].lo + v[0].hi; const CAT(LANE_T, 4) f = h.lo + h.hi
#elif W == 8
#define FOLD(v) const CAT(LANE_T, 8) h = v[0] + v[1]; const CAT(LANE_T, 4) f = h.lo + h.hi
#elif W == 4
#define FOLD(v) const CAT(LANE_T, 4) f = (v[0] + v[2]) + (v[1] + v[3])
#else
#define FOLD(v)                                                              \
  CAT(LANE_T, 4) f;                                                          \
  f.s0 = (v[0] + v[8]) + (v[4] + v[12]), f.s1 = (v[1] + v[9]) + (v[5] + v[13]); \
  f.s2 = (v[2] + v[10]) + (v[6] + v[14]), f.s3 = (v[3] + v[11]) + (v[7] + v[15])
#endif
inline float tree_sum(const FW *v) {
#define LANE_T float
  FOLD(v);
#undef LANE_T
  return (f.s0 + f.s2) + (f.s1 + f.s3);
}
// Counts hits; a lane holds -1 for each.
inline uint lane_count(const IW *v) {
#define LANE_T int
  FOLD(v);
#undef LANE_T
  return (uint)-((f.s0 + f.s2) + (f.s1 + f.s3));
}

// Loads a tile of an image, block by block.
inline void load_blocks(__global const float *image, uint tiles_x, int height, int tile_px, int tile_py, FW *r, FW *g, FW *b) {
  const size_t pitch = (size_t)tiles_x * TILE, plane = pitch * (((size_t)height + TILE - 1) / TILE * TILE);
  for (int block = 0; block < BLOCKS; ++block) {
    __global const float *at = image + (size_t)(tile_py + BLOCK * (block >> 2)) * pitch + tile_px + BLOCK * (block & 3);
    float lanes[3][16];
    for (int c = 0; c < 3; ++c)
      for (int row = 0; row < BLOCK; ++row) vstore4(vload4(0, at + c * plane + row * pitch), row, lanes[c]);
    for (int v = 0; v < BLOCK_VECTORS; ++v) {
      r[block * BLOCK_VECTORS + v] = LOADF(lanes[0], v * W);
      g[block * BLOCK_VECTORS + v] = LOADF(lanes[1], v * W);
      b[block * BLOCK_VECTORS + v] = LOADF(lanes[2], v * W);
    }
  }
}
#endif

__kernel void BLEND(
    const uint tiles_x,
    const uint blocks,                    // rows of `ends`
    const int width,                      // pixels
    const int height,
    const int resume,                     // 1: go on from `state`, 0: from an empty image
    const int finish,                     // 1: add the background and write the image, 0: write `state`
    const float background_r,
    const float background_g,
    const float background_b,
    __global const uint *ends,            // [blocks, tiles] the end of each tile's pairs in the last row
    __global const uint2 *pairs,          // row and block mask
    __global const float *records,        // [N, 16]
    __global float *state,                // [tiles, 4, 256] colour and signed transmittance, block by block
    __global float *image                 // [3, padded height, padded width] STATS > 1: finished before, and only read
#if STATS
    ,
    __global uint *hits,                  // [N]
    __global uint *sums                   // [N, SUMS, 2] low and high words of fixed-point sums
#endif
#if STATS > 2
    ,
    __global const float *rest            // [3, padded height, padded width] the residual
#endif
) {
  const uint tile = get_global_id(0);
  const int tile_px = (int)(tile % tiles_x) * TILE, tile_py = (int)(tile / tiles_x) * TILE;
  FW red[BLOCKS * BLOCK_VECTORS], green[BLOCKS * BLOCK_VECTORS], blue[BLOCKS * BLOCK_VECTORS];
  FW trans[BLOCKS * BLOCK_VECTORS];
  __global float *own = state + (size_t)tile * 1024;
  for (int k = 0; k < BLOCKS * BLOCK_VECTORS; ++k) {
    if (resume) {
      red[k] = LOADF(own, k * W);
      green[k] = LOADF(own, 256 + k * W);
      blue[k] = LOADF(own, 512 + k * W);
      trans[k] = LOADF(own, 768 + k * W);
    } else {
      const int b = k / BLOCK_VECTORS, v = k % BLOCK_VECTORS;
      FW x = lane_x_at(v) + (FW)(float)(tile_px + BLOCK * (b & 3)), y = lane_y(v) + (FW)(float)(tile_py + BLOCK * (b >> 2));
      red[k] = green[k] = blue[k] = (FW)0.0f;
      // Pixels outside the image count as ended, so that they have no hits.
      trans[k] = pick(MASK(x < (FW)(float)width) & MASK(y < (FW)(float)height), (FW)1.0f, (FW)-1.0f);
    }
  }

#if STATS
  const float largest = tile_largest((uint)get_global_size(0));
#endif
#if STATS == 2 || STATS >= 4
  FW whole_r[BLOCKS * BLOCK_VECTORS], whole_g[BLOCKS * BLOCK_VECTORS], whole_b[BLOCKS * BLOCK_VECTORS];
  load_blocks(image, tiles_x, height, tile_px, tile_py, whole_r, whole_g, whole_b);
#endif
#if STATS > 2
  FW rest_r[BLOCKS * BLOCK_VECTORS], rest_g[BLOCKS * BLOCK_VECTORS], rest_b[BLOCKS * BLOCK_VECTORS];
  load_blocks(rest, tiles_x, height, tile_px, tile_py, rest_r, rest_g, rest_b);
#if STATS == 5
  // Gradients need one number of the light that is still to come in a pixel: its product with the residual. It is kept in red.
  if (!resume)
    for (int k = 0; k < BLOCKS * BLOCK_VECTORS; ++k)
      red[k] = fma(whole_b[k], rest_b[k], fma(whole_g[k], rest_g[k], whole_r[k] * rest_r[k]));
#endif
#endif

  ends += (size_t)(blocks - 1) * get_global_size(0);
  const uint first = tile ? ends[tile - 1] : 0u, last = ends[tile];
  uint live = 0xFFFFu;
  // Pixels of block columns and rows, computed once a tile and not for each splat and block.
#if W == 1
  float x_of[TILE];
  for (int x = 0; x < TILE; ++x) x_of[x] = (float)(tile_px + x);
#define X_OF(b, v) x_of[BLOCK * ((b) & 3) + ((v) & 3)]
#else
  FW x_of[4];
  for (int column = 0; column < 4; ++column) x_of[column] = lane_x() + (FW)(float)(tile_px + BLOCK * column);
#define X_OF(b, v) x_of[(b) & 3]
#endif
  FW y_of[4 * BLOCK_VECTORS];
  for (int k = 0; k < 4 * BLOCK_VECTORS; ++k)
    y_of[k] = lane_y(k % BLOCK_VECTORS) + (FW)(float)(tile_py + BLOCK * (k / BLOCK_VECTORS));
  for (uint n = first; n < last; ++n) {
    if (((n - first) & (RETIRE_EVERY - 1)) == 0) {
      for (int b = 0; b < BLOCKS; ++b) {
        int alive = 0;
        for (int v = 0; v < BLOCK_VECTORS; ++v) alive |= any_alive(trans[b * BLOCK_VECTORS + v]);
        if (!alive) live &= ~(1u << b);
      }
      if (!live) break;
    }
    const uint2 pair = pairs[n];
    const size_t ahead = pairs[min(n + AHEAD, last - 1)].x;
    // Records and sums lie in row order, so those of a tile are all over the memory: without this hint, the blend waits for them.
    FETCH(records + ahead * 16);
#if STATS
    FETCH(sums + ahead * (2 * SUMS));
#if STATS == 5
    FETCH(sums + ahead * (2 * SUMS) + 2 * SUMS - 1);  // a row of 72 bytes may end in the next cache line
#endif
#endif
    uint mask = pair.y & live;
    if (!mask) continue;
    __global const float *r = records + (size_t)pair.x * 16;
    const FW mx = (FW)r[0], my = (FW)r[1], ca = (FW)r[2], cb = (FW)r[3], cc = (FW)r[4], level = (FW)r[5];
    const FW highest = highest_exponent(level);
    const FW cr = (FW)r[6], cg = (FW)r[7], cbl = (FW)r[8];
#if STATS
    IW hit_sum[BLOCK_VECTORS];
    FW weights[BLOCK_VECTORS], squares[BLOCK_VECTORS], errors[BLOCK_VECTORS];
    FW sum_r[BLOCK_VECTORS], sum_g[BLOCK_VECTORS], sum_b[BLOCK_VECTORS];
#if STATS == 5
    FW sum_x[BLOCK_VECTORS], sum_y[BLOCK_VECTORS], sum_xx[BLOCK_VECTORS], sum_xy[BLOCK_VECTORS], sum_yy[BLOCK_VECTORS];
    for (int v = 0; v < BLOCK_VECTORS; ++v) sum_x[v] = sum_y[v] = sum_xx[v] = sum_xy[v] = sum_yy[v] = (FW)0.0f;
#endif
    for (int v = 0; v < BLOCK_VECTORS; ++v) {
      hit_sum[v] = (IW)0;
      weights[v] = squares[v] = errors[v] = sum_r[v] = sum_g[v] = sum_b[v] = (FW)0.0f;
    }
#endif
    while (mask) {
      const int b = 31 - (int)clz(mask & (0u - mask));
      mask &= mask - 1;
      // For W of 8 or 4: without it, the compiler computes lane_y anew for each vector.
#pragma unroll
      for (int v = 0; v < BLOCK_VECTORS; ++v) {
        const int k = b * BLOCK_VECTORS + v;
        FW dx = X_OF(b, v) - mx, dy = y_of[(b >> 2) * BLOCK_VECTORS + v] - my;
        const FW exponent = splat_exponent(dx, dy, ca, cb, cc, level, highest);
        FW alpha, weight;
#if STATS == 5
        const FW before = trans[k];
#endif
#if STATS == 3 || STATS == 5
        const IW hit = pass_through(exponent, trans + k, &alpha, &weight);
#else
        const IW hit = blend_over(exponent, cr, cg, cbl, red + k, green + k, blue + k, trans + k, &alpha, &weight);
#endif
#if STATS == 1 || STATS == 5
        hit_sum[v] += hit;
#endif
#if STATS == 1 || STATS == 3 || STATS == 4
        weights[v] += weight;
#endif
#if STATS == 2 || STATS == 4
        // The change of the pixel without this splat: its own light goes, and the light behind it gets brighter. Written as one
        // product, which takes fewer operations than the plain form, and is as exact where nearly all of the light has come.
        const FW ratio = quotient(weight, trans[k]);
        const FW er = fma(cr, trans[k], red[k] - whole_r[k]), eg = fma(cg, trans[k], green[k] - whole_g[k]);
        const FW eb = fma(cbl, trans[k], blue[k] - whole_b[k]);
        errors[v] += ratio * ratio * fma(eb, eb, fma(eg, eg, er * er));
        squares[v] = fma(weight, weight, squares[v]);
#elif STATS == 5
        // That light times the residual is the gradient of the exponent, unless alpha is capped. Its moments about the splat's
        // centre are the gradients of the centre and of the conic.
        const FW own_light = fma(cbl, rest_b[k], fma(cg, rest_g[k], cr * rest_r[k]));
        const FW light = quotient(weight, trans[k]) * fma(own_light, before, -red[k]);
        red[k] = fma(-weight, own_light, red[k]);
        const FW slope = pick(MASK(alpha < (FW)ALPHA_MAX), light, (FW)0.0f), slope_x = slope * dx, slope_y = slope * dy;
        errors[v] += slope;
        sum_x[v] += slope_x;
        sum_y[v] += slope_y;
        sum_xx[v] = fma(slope_x, dx, sum_xx[v]);
        sum_xy[v] = fma(slope_x, dy, sum_xy[v]);
        sum_yy[v] = fma(slope_y, dy, sum_yy[v]);
#endif
#if STATS >= 3
        sum_r[v] = fma(weight, rest_r[k], sum_r[v]);
        sum_g[v] = fma(weight, rest_g[k], sum_g[v]);
        sum_b[v] = fma(weight, rest_b[k], sum_b[v]);
#endif
      }
    }
#if STATS
#if STATS == 1 || STATS == 5
    const uint some = lane_count(hit_sum);
#elif STATS == 3
    const uint some = tree_sum(weights) > 0.0f;
#else
    const uint some = tree_sum(squares) > 0.0f;
#endif
    if (some) {
#if STATS == 1
      atomic_add(hits + pair.x, some);
#endif
#if STATS == 1 || STATS == 3 || STATS == 4
      ADD_SUM(0, weights, FIXED_WEIGHT);
#endif
#if STATS == 3 || STATS == 4
      ADD_SUM(1, sum_r, FIXED_WEIGHT);
      ADD_SUM(2, sum_g, FIXED_WEIGHT);
      ADD_SUM(3, sum_b, FIXED_WEIGHT);
#endif
#if STATS == 2
      ADD_SUM(0, errors, FIXED_ERROR);
      ADD_SUM(1, squares, FIXED_ERROR);
#elif STATS == 4
      ADD_SUM(4, errors, FIXED_ERROR);
      ADD_SUM(5, squares, FIXED_ERROR);
#elif STATS == 5
      ADD_SUM(0, sum_r, FIXED_WEIGHT);
      ADD_SUM(1, sum_g, FIXED_WEIGHT);
      ADD_SUM(2, sum_b, FIXED_WEIGHT);
      ADD_SUM(3, errors, FIXED_WEIGHT);
      ADD_SUM(4, sum_x, FIXED_MOMENT);
      ADD_SUM(5, sum_y, FIXED_MOMENT);
      ADD_SUM(6, sum_xx, FIXED_MOMENT);
      ADD_SUM(7, sum_xy, FIXED_MOMENT);
      ADD_SUM(8, sum_yy, FIXED_MOMENT);
#endif
    }
#endif
  }

  if (!finish) {
    for (int k = 0; k < BLOCKS * BLOCK_VECTORS; ++k) {
      STOREF(red[k], own, k * W);
      STOREF(green[k], own, 256 + k * W);
      STOREF(blue[k], own, 512 + k * W);
      STOREF(trans[k], own, 768 + k * W);
    }
    return;
  }
#if STATS < 2
  const size_t pitch = (size_t)tiles_x * TILE, plane = pitch * (((size_t)height + TILE - 1) / TILE * TILE);
  for (int b = 0; b < BLOCKS; ++b) {
    float lanes[3][16];
    for (int v = 0; v < BLOCK_VECTORS; ++v) {
      const int k = b * BLOCK_VECTORS + v;
      const FW t = fabs(trans[k]);
      STOREF(fma(t, (FW)background_r, red[k]), lanes[0], v * W);
      STOREF(fma(t, (FW)background_g, green[k]), lanes[1], v * W);
      STOREF(fma(t, (FW)background_b, blue[k]), lanes[2], v * W);
    }
    __global float *at = image + (size_t)(tile_py + BLOCK * (b >> 2)) * pitch + tile_px + BLOCK * (b & 3);
    for (int c = 0; c < 3; ++c)
      for (int row = 0; row < BLOCK; ++row) vstore4(vload4(row, lanes[c]), 0, at + c * plane + row * pitch);
  }
#endif
}
