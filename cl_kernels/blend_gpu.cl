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
#define TOGETHER 4        // splats whose sums are taken at once, by 16 work-items each: barriers cost more than sums

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
#undef PARTS
#define PARTS (STATS == 2 || STATS >= 4 ? 2 : 1)   // values of a splat and pixel that sums are made of
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
  // For each part and each of the splats together, 256 pixels; then at its head, across these, the sums of lanes.
  __local float parts[PARTS * TOGETHER * 256];
  __local uint counts[TOGETHER];
#endif
#if STATS > 2
  __local float rests[3][256];
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
  STOREF(rest_r, rests[0], p * W);
  STOREF(rest_g, rests[1], p * W);
  STOREF(rest_b, rests[2], p * W);
#if STATS == 5
  // As in blend_cpu.cl: red keeps the product of the light to come with the residual.
  if (!resume)
    red = fma(LOADF(image, 2 * plane + here), rest_b,
              fma(LOADF(image, plane + here), rest_g, LOADF(image, here) * rest_r));
#endif
#endif
#if STATS
  if (p < TOGETHER) counts[p] = 0;
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
      const uint turn = n % TOGETHER;
#if STATS == 2 || STATS == 4
      const FW ratio = quotient(weight, t);
      const FW er = fma((FW)splats[n][6], t, red - whole_r), eg = fma((FW)splats[n][7], t, green - whole_g);
      const FW eb = fma((FW)splats[n][8], t, blue - whole_b);
      const FW error = ratio * ratio * fma(eb, eb, fma(eg, eg, er * er));
#elif STATS == 5
      const FW own_light = fma((FW)splats[n][8], rest_b, fma((FW)splats[n][7], rest_g, (FW)splats[n][6] * rest_r));
      const FW light = quotient(weight, t) * fma(own_light, before, -red);
      red = fma(-weight, own_light, red);
      const FW error = pick(MASK(alpha < (FW)ALPHA_MAX), light, (FW)0.0f);   // gradient of the exponent
#endif
      STOREF(weight, parts + 256 * turn, p * W);
#if PARTS == 2
      STOREF(error, parts + 256 * (TOGETHER + turn), p * W);
#endif
      if (ANY(hit)) atomic_add(counts + turn, hit_count(hit));
      if (turn + 1 < TOGETHER && n + 1 < size) continue;
      barrier(CLK_LOCAL_MEM_FENCE);
      // Work-item p sums lane p % 16 of a splat over the blocks in order. The pairwise tree over lanes follows: the order and fused
      // steps of blend_cpu.cl.
      const uint l = p % 16, splat = n - turn + p / 16;
      const bool summing = p / 16 <= turn;
      const uint seen = summing ? counts[p / 16] : 0u;
      float sum[SUMS];
#pragma unroll
      for (int c = 0; c < SUMS; ++c) sum[c] = 0.0f;
      if (summing) {
        __local const float *weights = parts + 256 * (p / 16), *errors = weights + 256 * TOGETHER * (PARTS - 1);
#pragma unroll
        for (int j = 0; j < 256; j += 16) {
          const int k = j + (int)l;
#if STATS == 2
          sum[0] += errors[k];
          sum[1] = fma(weights[k], weights[k], sum[1]);
#elif STATS != 5
          sum[0] += weights[k];
#endif
#if STATS == 3 || STATS == 4
#pragma unroll
          for (int c = 0; c < 3; ++c) sum[c + 1] = fma(weights[k], rests[c][k], sum[c + 1]);
#endif
#if STATS == 4
          sum[4] += errors[k];
          sum[5] = fma(weights[k], weights[k], sum[5]);
#elif STATS == 5
#pragma unroll
          for (int c = 0; c < 3; ++c) sum[c] = fma(weights[k], rests[c][k], sum[c]);
          const float kx = (float)((int)(tile % tiles_x) * TILE + BLOCK * (k >> 4 & 3) + (k & 3)) - splats[splat][0];
          const float ky = (float)((int)(tile / tiles_x) * TILE + BLOCK * (k >> 6) + (k >> 2 & 3)) - splats[splat][1];
          const float slope_x = errors[k] * kx, slope_y = errors[k] * ky;
          sum[3] += errors[k];
          sum[4] += slope_x;
          sum[5] += slope_y;
          sum[6] = fma(slope_x, kx, sum[6]);
          sum[7] = fma(slope_x, ky, sum[7]);
          sum[8] = fma(slope_y, ky, sum[8]);
#endif
        }
      }
      barrier(CLK_LOCAL_MEM_FENCE);
      __local float *lanes = parts + p / 16 * (SUMS * 16);
      if (summing)
#pragma unroll
        for (int c = 0; c < SUMS; ++c) lanes[c * 16 + l] = sum[c];
      if (p < TOGETHER) counts[p] = 0;
      barrier(CLK_LOCAL_MEM_FENCE);
      if (seen && l < SUMS) {
        const uint row = list[splat].x, c = l;
        __local const float *s = lanes + c * 16;
#if STATS == 1
        atomic_add(hits + row, seen);
#endif
        const float even = ((s[0] + s[8]) + (s[4] + s[12])) + ((s[2] + s[10]) + (s[6] + s[14]));
        const float odd = ((s[1] + s[9]) + (s[5] + s[13])) + ((s[3] + s[11]) + (s[7] + s[15]));
        add_fixed(sums + ((size_t)row * SUMS + c) * 2, even + odd, SUM_UNIT, tile_largest((uint)get_num_groups(0)));
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
