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
// One work-item is enough: a second launch would cost more than its counting.
// Each block has a row of its own. If the blocks of a cell lay side by side, two cores would fight over every cache line.
__kernel void exclusive_scan(
    const uint cells,
    const uint blocks,
    __global uint *values)            // [blocks, cells] and the total
{
  uint sum = 0;
  for (uint cell = 0; cell < cells; ++cell)
    for (uint block = 0; block < blocks; ++block) {
      const size_t i = (size_t)block * cells + cell;
      const uint value = values[i];
      values[i] = sum;
      sum += value;
    }
  values[(size_t)blocks * cells] = sum;
}
