// Front-to-back blending of one tile by one work-group, W pixels of a row a work-item; splats come in batches through local memory.
// It has the arguments, the written forms and the bits of blend_cpu.cl. No return before a barrier and no doubles.
// It takes 256 / W work-items and less than 16 KiB of local memory, so that small GPUs can run it.
// Twin: flexgs_edge.kernels.twins.blend

#if W != 1 && W != 4
#error "a work-item has 1 or 4 pixels of a row of a block: build with -DW=1 or 4"
#endif
#if !defined(STATS) || !defined(BLEND)
#error "BLEND (the kernel's name) and STATS (0: image only, 1: hits and weights, 2: removal costs, 3: residual, 4: residual and removal costs, 5: gradients) must be defined"
#endif

#define BATCH 64          // splats in local memory at a time
#define ITEMS (256 / W)   // work-items of a tile

#ifndef BLEND_HELPERS
#define BLEND_HELPERS
// Counts hits; a lane holds -1 for each.
inline uint hit_count(IW m) {
#if W == 1
  return (uint)-m;
#else
  return (uint)-((m.s0 + m.s2) + (m.s1 + m.s3));
#endif
}
#endif

#undef SUMS
#undef SUM_UNIT
#if STATS == 1
#define SUMS 1
#define SUM_UNIT FIXED_WEIGHT
#elif STATS == 2
#define SUMS 2
#define SUM_UNIT FIXED_ERROR
#elif STATS == 3
#define SUMS 4
#define SUM_UNIT FIXED_WEIGHT
#elif STATS == 4
#define SUMS 6
#define SUM_UNIT (c < 4 ? FIXED_WEIGHT : FIXED_ERROR)
#elif STATS == 5
#define SUMS 9
#define SUM_UNIT (c < 4 ? FIXED_WEIGHT : FIXED_MOMENT)
#endif

__kernel __attribute__((reqd_work_group_size(ITEMS, 1, 1))) void BLEND(
    const uint tiles_x,
    const uint blocks,
    const int width,
    const int height,
    const int resume,
    const int finish,
    const float background_r,
    const float background_g,
    const float background_b,
    __global const uint *ends,
    __global const uint2 *pairs,
    __global const float *records,
    __global float *state,
    __global float *image
#if STATS
    ,
    __global uint *hits,
    __global uint *sums
#endif
#if STATS > 2
    ,
    __global const float *rest
#endif
) {
  __local float splats[BATCH][9];
  __local uint2 list[BATCH];
  __local int open;
#if STATS
  __local float parts[SUMS][256];
  __local uint counts;
#endif
  // Pixels follow the blocks: place q is pixel q % 16 of block q / 16, and item p has W places. `state` has the same layout.
  const int p = get_local_id(0), b = p * W >> 4, lane = p * W & 15;
  const uint tile = get_group_id(0);
  const int left = (int)(tile % tiles_x) * TILE + BLOCK * (b & 3), top = (int)(tile / tiles_x) * TILE + BLOCK * (b >> 2);
  const FW px = TO_F(((LANE_INDEX + (IW)lane) & (IW)3) + (IW)left), py = TO_F(((LANE_INDEX + (IW)lane) >> 2) + (IW)top);
  __global float *own = state + (size_t)tile * 1024 + p * W;
  FW red = (FW)0.0f, green = (FW)0.0f, blue = (FW)0.0f;
  // Compared as floats: Oclgrind 21.10 finds vectors of four integers never less here.
  FW t = pick(MASK(px < (FW)(float)width) & MASK(py < (FW)(float)height), (FW)1.0f, (FW)-1.0f);
  if (resume) {
    red = LOADF(own, 0);
    green = LOADF(own, 256);
    blue = LOADF(own, 512);
    t = LOADF(own, 768);
  }
  const size_t pitch = (size_t)tiles_x * TILE, plane = pitch * (((size_t)height + TILE - 1) / TILE * TILE);
  const size_t here = (size_t)(top + (lane >> 2)) * pitch + left + (lane & 3);
#if STATS == 2 || STATS == 4
  const FW whole_r = LOADF(image, here), whole_g = LOADF(image, plane + here);
  const FW whole_b = LOADF(image, 2 * plane + here);
#endif
#if STATS > 2
  const FW rest_r = LOADF(rest, here), rest_g = LOADF(rest, plane + here);
  const FW rest_b = LOADF(rest, 2 * plane + here);
#if STATS == 5
  // As in blend_cpu.cl: red keeps the product of the light to come with the residual.
  if (!resume)
    red = fma(LOADF(image, 2 * plane + here), rest_b,
              fma(LOADF(image, plane + here), rest_g, LOADF(image, here) * rest_r));
#endif
#endif
  ends += (size_t)(blocks - 1) * get_num_groups(0);
  const uint first = tile ? ends[tile - 1] : 0u, last = ends[tile];
  for (uint start = first; start < last; start += BATCH) {
    barrier(CLK_LOCAL_MEM_FENCE);
    if (p == 0) open = 0;
    const uint size = min((uint)BATCH, last - start);
    for (uint n = p; n < size; n += ITEMS) {
      list[n] = pairs[start + n];
#pragma unroll
      for (int f = 0; f < 9; ++f) splats[n][f] = records[(size_t)list[n].x * 16 + f];
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    if (ANY(MASK(t > (FW)0.0f))) open = 1;
    barrier(CLK_LOCAL_MEM_FENCE);
    const int go_on = open;   // the same for the whole group, since nobody writes `open` before the next barrier
    if (!go_on) break;
    for (uint n = 0; n < size; ++n) {
      FW weight = (FW)0.0f, alpha = (FW)0.0f;
#if STATS == 5
      const FW before = t;
#endif
      IW hit = (IW)0;
      if (list[n].y >> b & 1u) {
        const FW dx = px - (FW)splats[n][0], dy = py - (FW)splats[n][1], level = (FW)splats[n][5];
        const FW exponent = splat_exponent(
            dx, dy, (FW)splats[n][2], (FW)splats[n][3], (FW)splats[n][4], level, highest_exponent(level));
#if STATS == 3 || STATS == 5
        hit = pass_through(exponent, &t, &alpha, &weight);
#else
        hit = blend_over(
            exponent, (FW)splats[n][6], (FW)splats[n][7], (FW)splats[n][8], &red, &green, &blue, &t, &alpha, &weight);
#endif
      }
#if STATS
      if (p == 0) counts = 0;
#if STATS == 2 || STATS == 4
      const FW ratio = weight / t;
      const FW er = fma((FW)splats[n][6], t, red - whole_r), eg = fma((FW)splats[n][7], t, green - whole_g);
      const FW eb = fma((FW)splats[n][8], t, blue - whole_b);
      const FW error = ratio * ratio * fma(eb, eb, fma(eg, eg, er * er));
#elif STATS == 5
      const FW own_light = fma((FW)splats[n][8], rest_b, fma((FW)splats[n][7], rest_g, (FW)splats[n][6] * rest_r));
      const FW light = (weight / t) * fma(own_light, before, -red);
      red = fma(-weight, own_light, red);
      const FW error = pick(MASK(alpha < (FW)ALPHA_MAX), light, (FW)0.0f);   // gradient of the exponent
#endif
#if STATS == 2
      STOREF(error, parts[0], p * W);
      STOREF(weight, parts[1], p * W);
#else
      STOREF(weight, parts[0], p * W);
#endif
#if STATS >= 3
      STOREF(rest_r, parts[1], p * W);
      STOREF(rest_g, parts[2], p * W);
      STOREF(rest_b, parts[3], p * W);
#endif
#if STATS >= 4
      STOREF(error, parts[4], p * W);
#endif
      barrier(CLK_LOCAL_MEM_FENCE);
      if (ANY(hit)) atomic_add(&counts, hit_count(hit));
      // Each lane sums over the blocks in order, then the pairwise tree over lanes: the order and fused steps of blend_cpu.cl.
      float sum[SUMS];
#pragma unroll
      for (int c = 0; c < SUMS; ++c) sum[c] = 0.0f;
      if (p < 16) {
#pragma unroll
        for (int j = 0; j < 256; j += 16) {
          const int k = j + p;
#if STATS != 5
          sum[0] += parts[0][k];
#endif
#if STATS == 2
          sum[1] = fma(parts[1][k], parts[1][k], sum[1]);
#elif STATS == 3 || STATS == 4
#pragma unroll
          for (int c = 1; c < 4; ++c) sum[c] = fma(parts[0][k], parts[c][k], sum[c]);
#endif
#if STATS == 4
          sum[4] += parts[4][k];
          sum[5] = fma(parts[0][k], parts[0][k], sum[5]);
#elif STATS == 5
#pragma unroll
          for (int c = 0; c < 3; ++c) sum[c] = fma(parts[0][k], parts[c + 1][k], sum[c]);
          const float kx = (float)((int)(tile % tiles_x) * TILE + BLOCK * (k >> 4 & 3) + (k & 3)) - splats[n][0];
          const float ky = (float)((int)(tile / tiles_x) * TILE + BLOCK * (k >> 6) + (k >> 2 & 3)) - splats[n][1];
          const float slope_x = parts[4][k] * kx, slope_y = parts[4][k] * ky;
          sum[3] += parts[4][k];
          sum[4] += slope_x;
          sum[5] += slope_y;
          sum[6] = fma(slope_x, kx, sum[6]);
          sum[7] = fma(slope_x, ky, sum[7]);
          sum[8] = fma(slope_y, ky, sum[8]);
#endif
        }
      }
      barrier(CLK_LOCAL_MEM_FENCE);
      if (p < 16)
#pragma unroll
        for (int c = 0; c < SUMS; ++c) parts[c][p] = sum[c];
      barrier(CLK_LOCAL_MEM_FENCE);
      if (p == 0 && counts) {
        const uint row = list[n].x;
#if STATS == 1
        atomic_add(hits + row, counts);
#endif
#pragma unroll
        for (int c = 0; c < SUMS; ++c) {
          __local float *s = parts[c];
#pragma unroll
          for (int l = 0; l < 8; ++l) s[l] += s[l + 8];
#pragma unroll
          for (int l = 0; l < 4; ++l) s[l] += s[l + 4];
          add_fixed(sums + ((size_t)row * SUMS + c) * 2, (s[0] + s[2]) + (s[1] + s[3]), SUM_UNIT,
                    tile_largest((uint)get_num_groups(0)));
        }
      }
      barrier(CLK_LOCAL_MEM_FENCE);
#endif
    }
  }
  if (finish) {
#if STATS < 2
    __global float *at = image + here;
    STOREF(fma(fabs(t), (FW)background_r, red), at, 0);
    STOREF(fma(fabs(t), (FW)background_g, green), at + plane, 0);
    STOREF(fma(fabs(t), (FW)background_b, blue), at + 2 * plane, 0);
#endif
  } else {
    STOREF(red, own, 0);
    STOREF(green, own, 256);
    STOREF(blue, own, 512);
    STOREF(t, own, 768);
  }
}
