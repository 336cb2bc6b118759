// Stable radix sort (least significant digit first) of the shown splats by depth, and the scan that the tile lists use too.
// A work-item walks one contiguous block of elements in order, so that equal keys keep their order for any number of blocks.
// Twins: flexgs_edge.kernels.twins.sort

#define DIGIT_BITS 11
#define DIGITS (1 << DIGIT_BITS)

inline void block_range(uint count, uint *start, uint *end) {
  const uint blocks = get_global_size(0), block = get_global_id(0);
  *start = (uint)((ulong)count * block / blocks);
  *end = (uint)((ulong)count * (block + 1) / blocks);
}

// Histogram of the first digit. Culled splats are left out here, so the first pass also compacts.
__kernel void sort_count_first(
    const uint count,
    __global const uint *keys,        // [N]
    __global const uint *bounds,      // [N] tiles of each splat's bounding box
    __global uint *counts,            // [blocks, DIGITS]
    __global ulong *pairs)            // [blocks] sum of bounds of the shown splats
{
  const uint block = get_global_id(0);
  uint start, end;
  block_range(count, &start, &end);
  __global uint *own = counts + block * DIGITS;
  for (uint d = 0; d < DIGITS; ++d) own[d] = 0;
  ulong sum = 0;
  for (uint i = start; i < end; ++i) {
    const uint key = keys[i];
    if (key == (uint)CULLED) continue;
    own[key & (DIGITS - 1)] += 1;
    sum += bounds[i];
  }
  pairs[block] = sum;
}

__kernel void sort_scatter_first(
    const uint count,
    __global const uint *keys,        // [N]
    __global uint *offsets,           // [blocks, DIGITS] from the scan; advanced
    __global uint *keys_out,          // [N]
    __global uint *ids_out)           // [N] rows
{
  const uint block = get_global_id(0);
  uint start, end;
  block_range(count, &start, &end);
  for (uint i = start; i < end; ++i) {
    const uint key = keys[i];
    if (key == (uint)CULLED) continue;
    const uint at = offsets[block * DIGITS + (key & (DIGITS - 1))]++;
    keys_out[at] = key;
    ids_out[at] = i;
  }
}

__kernel void sort_count(
    const uint count,
    const uint shift,
    __global const uint *keys,        // [count]
    __global uint *counts)            // [blocks, DIGITS]
{
  const uint block = get_global_id(0);
  uint start, end;
  block_range(count, &start, &end);
  __global uint *own = counts + block * DIGITS;
  for (uint d = 0; d < DIGITS; ++d) own[d] = 0;
  for (uint i = start; i < end; ++i) own[(keys[i] >> shift) & (DIGITS - 1)] += 1;
}

__kernel void sort_scatter(
    const uint count,
    const uint shift,
    __global const uint *keys,        // [count]
    __global const uint *ids,         // [count]
    __global uint *offsets,           // [blocks, DIGITS] from the scan; advanced
    __global uint *keys_out,          // [count]
    __global uint *ids_out)           // [count]
{
  const uint block = get_global_id(0);
  uint start, end;
  block_range(count, &start, &end);
  for (uint i = start; i < end; ++i) {
    const uint key = keys[i];
    const uint at = offsets[block * DIGITS + ((key >> shift) & (DIGITS - 1))]++;
    keys_out[at] = key;
    ids_out[at] = ids[i];
  }
}

// Offsets of every cell and block, in place: cell by cell, and block by block within a cell. values[blocks * cells] gets the total.
// On a CPU, one work-item is enough: a second launch would cost more than its counting. A GPU takes one work-group.
// Each block has a row of its own. If the blocks of a cell lay side by side, two cores would fight over every cache line.
#ifdef GROUP
#define AHEAD_BLOCKS 8   // blocks read before the first of them is written, so that reads do not wait for each other
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1))) void exclusive_scan(
    const uint cells,
    const uint blocks,
    __global uint *values)            // [blocks, cells] and the total
{
  __local uint sums[GROUP];
  const uint p = get_local_id(0);
  uint before = 0;   // sum of all cells before those of this turn
  for (uint first = 0; first < cells; first += GROUP) {
    const uint cell = first + p;
    uint own = 0;
    if (cell < cells)
      for (uint block = 0; block < blocks; ++block) own += values[(size_t)block * cells + cell];
    sums[p] = own;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint reach = 1; reach < GROUP; reach *= 2) {
      const uint more = p < reach ? 0u : sums[p - reach];
      barrier(CLK_LOCAL_MEM_FENCE);
      sums[p] += more;
      barrier(CLK_LOCAL_MEM_FENCE);
    }
    uint sum = before + sums[p] - own;
    before += sums[GROUP - 1];
    barrier(CLK_LOCAL_MEM_FENCE);
    if (cell < cells)
      for (uint from = 0; from < blocks; from += AHEAD_BLOCKS) {
        uint counts[AHEAD_BLOCKS];
#pragma unroll
        for (uint k = 0; k < AHEAD_BLOCKS; ++k)
          counts[k] = from + k < blocks ? values[(size_t)(from + k) * cells + cell] : 0u;
#pragma unroll
        for (uint k = 0; k < AHEAD_BLOCKS; ++k) {
          if (from + k < blocks) values[(size_t)(from + k) * cells + cell] = sum;
          sum += counts[k];
        }
      }
  }
  if (p == 0) values[(size_t)blocks * cells] = before;
}
#else
__kernel void exclusive_scan(
    const uint cells,
    const uint blocks,
    __global uint *values)            // [blocks, cells] and the total
{
  uint sum = 0, cell = 0;
#if W > 1
  // W cells at a time: first their sums over all blocks, then the offsets.
  for (; cell + W <= cells; cell += W) {
    UW before = (UW)0u;
    for (uint block = 0; block < blocks; ++block) before += LOADF(values, (size_t)block * cells + cell);
    uint lanes[W];
    STOREI(before, lanes, 0);
    for (uint lane = 0; lane < W; ++lane) {
      const uint own = lanes[lane];
      lanes[lane] = sum;
      sum += own;
    }
    before = LOADF(lanes, 0);
    for (uint block = 0; block < blocks; ++block) {
      const size_t i = (size_t)block * cells + cell;
      const UW own = LOADF(values, i);
      STOREI(before, values, i);
      before += own;
    }
  }
#endif
  for (; cell < cells; ++cell)
    for (uint block = 0; block < blocks; ++block) {
      const size_t i = (size_t)block * cells + cell;
      const uint own = values[i];
      values[i] = sum;
      sum += own;
    }
  values[(size_t)blocks * cells] = sum;
}
#endif
