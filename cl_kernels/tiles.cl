// Tile lists in depth order: the splats that may show in each tile, and in which of its sixteen 4x4 blocks.
// It is a counting sort by tile. The depth-ordered splats are cut into blocks. On CPUs a work-item walks a block, on GPUs a work-group does.
// Twins: flexgs_edge.kernels.twins.tiles

// Block rows (4 pixels high) worked on at a time: four rows of tiles, or one on GPUs, where each has a work-item.
#ifdef GROUP
#define BANDS 4
#else
#define BANDS 16
#endif

// First and last block column of a splat in W block rows from `band` on.
inline void splat_spans(__global const float *r, int band, float width, IW *first, IW *last) {
  block_spans(LANE_INDEX + (IW)band, (FW)r[0], (FW)r[1], (FW)r[9], (FW)r[10], (FW)r[11], (FW)r[12], (FW)r[13], (FW)r[14], width, first,
              last);
}

// The 16-bit block mask of a tile, bit 4 * row + column. `first` and `last` are the spans of the tile's four block rows.
// A tile has four block rows, so there are four lanes for any W.
inline uint tile_mask(int4 first, int4 last, int tile_x) {
  const int4 from = max(first - 4 * tile_x, (int4)0), to = min(last - 4 * tile_x, (int4)3);
  const uint4 upto = ((uint4)(2u) << as_uint4(max(to, (int4)0))) - 1u, below = ((uint4)(1u) << as_uint4(min(from, (int4)4))) - 1u;
  const uint4 rows = select((uint4)(0u), upto & ~below, from <= to) << (uint4)(0u, 4u, 8u, 12u);
  return (rows.s0 | rows.s1) | (rows.s2 | rows.s3);
}

// The row of tiles at a height in pixels, clamped to the image. A splat that ends between two pixels may get one row too many, in
// which the spans of its block rows are empty.
inline int tile_row(float y, float height) {
  const float last = height - 1.0f;
  return (int)(y > 0.0f ? y < last ? y : last : 0.0f) / TILE;
}

// First and last row of tiles that a splat may reach; none if the first is beyond the last.
inline int2 rows_of_tiles(__global const float *r, float height) {
  const float slack = fma(r[10], SPAN_SLACK_RELATIVE, SPAN_SLACK);
  return (int2)(tile_row(r[1] - r[10] - slack, height), tile_row(r[1] + r[10] + slack, height));
}

// Calls EACH(tile, mask) for every tile in which the splat of record `r` may show, in BANDS / 4 rows of tiles from `top` on, of those up
// to `ty1`.
#define FOR_EACH_TILE(r, top, ty1, EACH)                                                                        \
  {                                                                                                             \
    int first[BANDS], last[BANDS];                                                                              \
    const int bands = min(BANDS, 4 * (ty1 - top + 1));                                                          \
    for (int v = 0; v < bands; v += W) {                                                                        \
      IW f, l;                                                                                                  \
      splat_spans(r, top * 4 + v, width, &f, &l);                                                               \
      STOREI(f, first, v);                                                                                      \
      STOREI(l, last, v);                                                                                       \
    }                                                                                                           \
    for (int t = 0; t < BANDS / 4 && top + t <= ty1; ++t) {                                                     \
      const int4 f4 = vload4(t, first), l4 = vload4(t, last);                                                   \
      const int from = min(min(f4.s0, f4.s1), min(f4.s2, f4.s3));                                               \
      const int to = max(max(l4.s0, l4.s1), max(l4.s2, l4.s3));                                                 \
      for (int tx = from >> 2; tx <= to >> 2; ++tx) {                                                           \
        const uint mask = tile_mask(f4, l4, tx);                                                                \
        if (mask) EACH((top + t) * tiles_x + tx, mask);                                                         \
      }                                                                                                         \
    }                                                                                                           \
  }

inline void splat_range(uint from, uint count, uint *start, uint *end) {
  const uint blocks = get_num_groups(0), block = get_group_id(0);
  *start = from + (uint)((ulong)count * block / blocks);
  *end = from + (uint)((ulong)count * (block + 1) / blocks);
}

// Counts the drafts that each block of splats may write: an upper bound, from the bounds that `project` counted.
__kernel void tile_room(
    const uint from,                  // first splat of the batch in depth order
    const uint count,                 // splats of the batch
    __global const uint *ids,         // [shown] rows in depth order
    __global const uint *bounds,      // [N] tiles of each splat's bounding box
    __global uint *room)              // [2, blocks] drafts of each block: at most, and (later) as many as there are
{
  uint start, end, sum = 0;
  splat_range(from, count, &start, &end);
  for (uint n = start; n < end; ++n) sum += bounds[ids[n]];
  room[get_group_id(0)] = sum;
}

inline size_t draft_start(__global const uint *room) {
  size_t start = 0;
  for (uint block = 0; block < get_group_id(0); ++block) start += room[block];
  return start;
}

#ifdef GROUP
#define LISTERS __attribute__((reqd_work_group_size(LIST_GROUP, 1, 1)))
#else
#define LISTERS
#endif

// Computes the spans, and drafts of the pairs; `tile_scatter` then only moves the drafts.
__kernel LISTERS void tile_count(
    const uint from,
    const uint count,
    const float width,                // pixels
    const float height,
    __global const uint *ids,         // [shown]
    __global const float *records,    // [N, 16]
    __global uint *room,              // [2, blocks] see `tile_room`
    __global uint *drafts,            // [capacity, 3] row, tile and block mask, splat by splat
    __global uint *counts)            // [blocks, tiles]
{
  const int tiles_x = ((int)width + TILE - 1) / TILE, tiles_y = ((int)height + TILE - 1) / TILE;
  __global uint *own = counts + get_group_id(0) * (size_t)(tiles_x * tiles_y);
  __global uint *const first_draft = drafts + 3 * draft_start(room);
  __global uint *draft = first_draft;
  uint start, end;
  splat_range(from, count, &start, &end);
#ifdef GROUP
  // Of LIST_GROUP splats, each work-item has one row of tiles at a time, so that a large splat does not keep the others waiting. It
  // counts its tiles, and drafts them behind those of the rows before.
  __local uint found[LIST_GROUP], rows[LIST_GROUP];
  const uint p = get_local_id(0);
  for (int tile = (int)p; tile < tiles_x * tiles_y; tile += LIST_GROUP) own[tile] = 0;
  barrier(CLK_GLOBAL_MEM_FENCE);
  uint drafted = 0;
#define COUNT_PAIR(tile, mask) (mine += 1, atomic_add(own + (tile), 1u))
#define DRAFT_PAIR(tile, mask) (vstore3((uint3)(id, (uint)(tile), mask), 0, draft), draft += 3)
  for (uint from_splat = start; from_splat < end; from_splat += LIST_GROUP) {
    // Rows of tiles of each splat, and of those up to it.
    int2 span = (int2)(0, -1);
    if (from_splat + p < end) span = rows_of_tiles(records + (size_t)ids[from_splat + p] * 16, height);
    found[p] = (uint)max(span.s1 - span.s0 + 1, 0);
    barrier(CLK_LOCAL_MEM_FENCE);
    uint upto = 0;
    for (uint q = 0; q <= p; ++q) upto += found[q];
    rows[p] = upto;
    barrier(CLK_LOCAL_MEM_FENCE);
    const uint all_rows = rows[LIST_GROUP - 1];
    for (uint first_row = 0; first_row < all_rows; first_row += LIST_GROUP) {
      const uint row = first_row + p;
      uint mine = 0, before = 0, all = 0, splat = 0, id = 0;
      int top = 0;
      __global const float *r = records;
      if (row < all_rows) {
        for (uint stride = LIST_GROUP / 2; stride; stride /= 2)
          if (rows[splat + stride - 1] <= row) splat += stride;
        id = ids[from_splat + splat];
        r = records + (size_t)id * 16;
        top = rows_of_tiles(r, height).s0 + (int)(row - (splat ? rows[splat - 1] : 0u));
        FOR_EACH_TILE(r, top, top, COUNT_PAIR)
      }
      found[p] = mine;
      barrier(CLK_LOCAL_MEM_FENCE);
      for (uint q = 0; q < LIST_GROUP; ++q) {
        before += q < p ? found[q] : 0u;
        all += found[q];
      }
      barrier(CLK_LOCAL_MEM_FENCE);
      draft = first_draft + 3 * (size_t)(drafted + before);
      if (row < all_rows) {
        FOR_EACH_TILE(r, top, top, DRAFT_PAIR)
      }
      drafted += all;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
  }
  if (p == 0) room[get_num_groups(0) + get_group_id(0)] = drafted;
#else
  for (int tile = 0; tile < tiles_x * tiles_y; ++tile) own[tile] = 0;
#define DRAFT_PAIR(tile, mask) (vstore3((uint3)(ids[n], (uint)(tile), mask), 0, draft), draft += 3, own[tile] += 1)
  for (uint n = start; n < end; ++n) {
    FETCH(records + (size_t)ids[min(n + AHEAD, end - 1)] * 16);
    __global const float *r = records + (size_t)ids[n] * 16;
    const uint only = as_uint(r[15]);
    if (only) {
      DRAFT_PAIR(only >> 16, only & 0xFFFFu);
      continue;
    }
    const int2 span = rows_of_tiles(r, height);
    for (int top = span.s0; top <= span.s1; top += BANDS / 4) {
      FOR_EACH_TILE(r, top, span.s1, DRAFT_PAIR)
    }
  }
  room[get_num_groups(0) + get_group_id(0)] = (uint)((draft - first_draft) / 3);
#endif
}

__kernel LISTERS void tile_scatter(
    const uint tiles,
    __global const uint *room,        // [2, blocks]
    __global const uint *drafts,      // [capacity, 3]
    __global uint *offsets,           // [blocks, tiles] from the scan; advanced, so that the last row has the tiles' ends
    __global uint2 *pairs)            // [capacity] row and block mask, tile by tile, in depth order
{
  __global uint *own = offsets + get_group_id(0) * (size_t)tiles;
  __global const uint *draft = drafts + 3 * draft_start(room);
  const uint count = room[get_num_groups(0) + get_group_id(0)];
#ifdef GROUP
  // Each work-item has one draft of LIST_GROUP. It goes behind those of its tile before it; the last of a tile counts them.
  __local uint tile_of[LIST_GROUP];
  const uint p = get_local_id(0);
  for (uint first = 0; first < count; first += LIST_GROUP) {
    const uint n = first + p, size = min((uint)LIST_GROUP, count - first);
    const uint3 d = n < count ? vload3(n, draft) : (uint3)(0u);
    tile_of[p] = d.s1;
    barrier(CLK_LOCAL_MEM_FENCE);
    uint before = 0, all = 0;
    for (uint q = 0; q < size; ++q) {
      const uint same = tile_of[q] == d.s1 ? 1u : 0u;
      before += q < p ? same : 0u;
      all += same;
    }
    uint at = 0;
    if (n < count) {
      at = own[d.s1];
      pairs[at + before] = (uint2)(d.s0, d.s2);
    }
    barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);
    if (n < count && before + 1 == all) own[d.s1] = at + all;
    barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);
  }
#else
  for (uint n = 0; n < count; ++n) {
    const uint3 d = vload3(n, draft);
    pairs[own[d.s1]++] = (uint2)(d.s0, d.s2);
  }
#endif
}
