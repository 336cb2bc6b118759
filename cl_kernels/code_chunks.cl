// Decodes version 2 chunks (docs/format.md), or counts their symbols, one work-item a chunk: octree, repeats, and every channel.
// Specification: flexgs_edge.codec.v2 (walk), with the same numbers to the last bit.

inline uint every_third(ulong bits) {
  bits &= 0x1249249249249249ul;
  bits = (bits | bits >> 2) & 0x10c30c30c30c30c3ul;
  bits = (bits | bits >> 4) & 0x100f00f00f00f00ful;
  bits = (bits | bits >> 8) & 0x1f0000ff0000fful;
  bits = (bits | bits >> 16) & 0x1f00000000fffful;
  return (uint)(bits | bits >> 32) & 0x1fffff;
}

// Decodes the cells of all rows (into the first of two planes), and their coordinates.
inline bool get_positions(Chunk *c, uint rows, uint depth, __global ulong *cells, __global int *out) {
  __global uchar *context = c->bytes + (size_t)CONTEXT * c->stride, *symbol = c->bytes + (size_t)SYMBOL * c->stride;
  __global uchar *children = c->bytes + (size_t)CHILDREN * c->stride, *grown_children = children + c->stride;
  __global ulong *nodes = cells + (depth & 1 ? 0 : c->stride), *grown = cells + (depth & 1 ? c->stride : 0);
  uint count = 1;
  nodes[0] = 0;
  children[0] = 0;
  for (int level = (int)depth - 1; level >= 0; --level) {
    const uint first = min(level, LEVEL_CLASSES - 1) * CHILD_CLASSES;
    for (uint i = 0; i < count; ++i) context[i] = (uchar)(first + min((uint)children[i], (uint)(CHILD_CLASSES - 1)));
    if (!get_batch(c, 0, count)) return false;
    uint total = 0, empty = 0;
    for (uint i = 0; i < count; ++i) {
      total += popcount((uint)symbol[i]);
      empty |= symbol[i] == 0;
    }
    if (empty) return failed(c, NO_CHILDREN, 0, 0);
    if (total > rows) return failed(c, NODES, total, level);
    uint to = 0;
    for (uint i = 0; i < count; ++i) {
      const ulong node = nodes[i] << 3;
      uint left = symbol[i];
      const uchar siblings = (uchar)popcount(left);
      for (; left; left &= left - 1) {
        grown[to] = node | popcount((left & -left) - 1);
        grown_children[to++] = siblings;
      }
    }
    count = total;
    __global ulong *swap = nodes;
    nodes = grown;
    grown = swap;
    __global uchar *swap_children = children;
    children = grown_children;
    grown_children = swap_children;
  }
  __global uint *raw = (__global uint *)(c->ints + (size_t)RAW * c->stride);
  const uint last = c->records[RECORD + SYMBOLS] - 1;
  for (uint i = 0; i < count; ++i) context[i] = 0;
  if (!get_batch(c, 1, count)) return false;
  uint escapes = 0;
  for (uint i = 0; i < count; ++i) escapes += symbol[i] == last;
  if (!get_raw(c, escapes, 32, raw)) return false;
  ulong sum = 0;
  for (uint i = 0, escape = 0; i < count; ++i) sum += symbol[i] == last ? raw[escape++] : symbol[i];
  if (sum + count != rows) return failed(c, REPEATS, (long)sum, rows - count);
  __global float *x = plane(c, X), *y = plane(c, Y), *z = plane(c, Z);
  uint to = 0;
  for (uint i = 0, escape = 0; i < count; ++i) {
    const ulong cell = nodes[i];
    const uint cx = every_third(cell >> 2), cy = every_third(cell >> 1), cz = every_third(cell);
    for (uint left = (symbol[i] == last ? raw[escape++] : symbol[i]) + 1; left; --left, ++to) {
      grown[to] = cell;
      x[to] = (float)(out[to] = (int)cx);
      y[to] = (float)(out[c->stride + to] = (int)cy);
      z[to] = (float)(out[2 * c->stride + to] = (int)cz);
    }
  }
  return true;
}

// Codes the base channel `channel`, predicted from the channels of `sources` (numbers of base channels, in the format's order).
inline bool get_base(Chunk *c, uint channel, uint rows, __global const ushort *weights, uint sources, uint source_count, __global int *out) {
  Terms terms;
  terms.count = 0;
  add_term(&terms, plane(c, NEAR), 2);
  for (uint i = 0; i < source_count; ++i) {
    __global const float *values = plane(c, BASE + 3 * (sources >> 4 * i & 15));
    for (uint part = 0; part < 3; ++part) add_term(&terms, values + part * c->stride, 3 + 3 * i + part);
  }
  const bool kept = channel < DEGREE;
  __global float *value = plane(c, BASE + 3 * (kept ? channel : 0));
  return get_channel(c, 2 + channel, rows, 4, weights, &terms, kept ? value : 0, kept ? value + c->stride : 0,
                     kept ? value + 2 * c->stride : 0, out + channel * c->stride);
}

// Prepares a degree: sums over the degree below, and base channels that predict SH, for rows with `degree`; returns their number.
inline uint begin_degree(Chunk *c, uint rows, uint before_count, int degree, __global const int *degrees, __global ushort *weights) {
  __global int *subset = c->ints + (size_t)SUBSET * c->stride, *came_from = c->ints + (size_t)CAME_FROM * c->stride;
  const uint stride = c->stride;
  uint count = 0;
  for (uint i = 0; i < before_count; ++i) {
    const int row = subset[i];
    subset[count] = row;
    came_from[count] = (int)i;
    count += degrees[row] >= degree;
  }
  if (!count) return 0;
  if (degree == 1 || count != before_count) {
    plan_passes(c, count, 2, weights, plane(c, NEAR_SH));
    const uint top = passes(count), top_rows = passes(rows), top_before = passes(before_count);
    const uint sources[4] = {OPACITY, 0, 1, 2};
    for (int k = (int)top; k >= 0; --k) {
      const bool first = k == (int)top;
      const uint begin = first ? 0 : begin_of(count, k), size = first ? ((count - 1) >> top) + 1 : size_of(count, k);
      for (uint j = 0; j < size; ++j) {
        const uint i = first ? j << k : (2 * j + 1) << k;
        const uint at = place_of(subset[i], rows, top_rows), at_before = place_of(came_from[i], before_count, top_before);
        for (uint p = 0; p < 4; ++p) plane(c, STEADY + 3 + p)[begin + j] = plane(c, BASE + 3 * sources[p])[at];
        for (uint p = 0; p < 3 && degree > 1; ++p)
          plane(c, STEADY + p)[begin + j] = min(plane(c, BEFORE + (p + 1) % 3)[at_before], 256 * VALUE_LIMIT);
      }
    }
  } else {
    for (uint p = 0; p < 3; ++p)
      for (uint j = 0; j < count; ++j) plane(c, STEADY + p)[j] = min(plane(c, BEFORE + (p + 1) % 3)[j], 256 * VALUE_LIMIT);
  }
  for (uint p = 0; p < 3 && degree == 1; ++p)
    for (uint j = 0; j < count; ++j) plane(c, STEADY + p)[j] = 0.0f;
  for (uint p = 0; p < 3; ++p)
    for (uint j = 0; j < count; ++j) plane(c, BEFORE + p)[j] = 0.0f;
  return count;
}

// Codes one coefficient: Y, Co, Cg. Features: sums of |Cg|, |Y|, |Co| so far, then Y, |Y|, Co, |Co| of this coefficient.
inline bool get_coefficient(Chunk *c, uint alphabet, uint count, __global const ushort *weights, uint colour_stride, __global int *out) {
  const uint places[3][7] = {{3}, {11, 3, 9, 10}, {3, 13, 14, 9, 10, 11, 12}};
  const uint sizes[3] = {1, 4, 7};
  for (uint colour = 0; colour < 3; ++colour) {
    Terms terms;
    terms.count = 0;
    add_term(&terms, plane(c, NEAR_SH), 2);
    for (uint p = 0; p < 4; ++p) add_term(&terms, plane(c, STEADY + 3 + p), 5 + p);
    add_term(&terms, plane(c, STEADY + colour), 4);
    for (uint p = 0; p < sizes[colour]; ++p) add_term(&terms, plane(c, BEFORE + (colour < 2) + p), places[colour][p]);
    __global float *value = plane(c, BEFORE + 3 + 2 * colour), *away = colour < 2 ? value + c->stride : plane(c, SPARE);
    if (!get_channel(c, alphabet + colour, count, 2, weights, &terms, colour < 2 ? value : 0, 0, away, out + (size_t)colour * colour_stride))
      return false;
  }
  __global const float *cg = plane(c, SPARE), *y = plane(c, BEFORE + 4), *co = plane(c, BEFORE + 6);
  __global float *cg_sum = plane(c, BEFORE), *y_sum = plane(c, BEFORE + 1), *co_sum = plane(c, BEFORE + 2);
  for (uint j = 0; j < count; j += W) {
    STORE(LOAD(cg_sum, j) + LOAD(cg, j), cg_sum, j);
    STORE(LOAD(y_sum, j) + LOAD(y, j), y_sum, j);
    STORE(LOAD(co_sum, j) + LOAD(co, j), co_sum, j);
  }
  return true;
}

// Codes all channels: decodes into `out`, or counts from there.
inline bool get_channels(Chunk *c, uint rows, int sh_degree, bool base_only, __global ushort *weights, __global int *out) {
  const uint stride = c->stride;
  __global int *subset = c->ints + (size_t)SUBSET * stride;
  for (uint i = 0; i < rows; ++i) subset[i] = (int)i;
  plan_passes(c, rows, 4, weights, plane(c, NEAR));
  // The channels that predict each channel: four bits for each of them, lowest first.
  const uint sources[CHANNELS] = {0, 0x0, 0x10, 0x210, 0x2103, 0x34, 0x54, 0x6543, 0x210, 0x210, 0x210};
  const uint counts[CHANNELS] = {0, 1, 2, 3, 4, 2, 2, 4, 3, 3, 3};
  __global int *degrees = out + DEGREE * stride;
  for (uint channel = 0; channel < CHANNELS; ++channel) {
    if (channel == DEGREE && !sh_degree) {
      for (uint i = 0; i < rows && !c->counting; ++i) degrees[i] = 0;
      continue;
    }
    if (!get_base(c, channel, rows, weights, sources[channel], counts[channel], out)) return false;
    if (channel == DEGREE) {
      int low = degrees[0], high = degrees[0];
      for (uint i = 1; i < rows; ++i) {
        low = min(low, degrees[i]);
        high = max(high, degrees[i]);
      }
      if (low < 0 || high > sh_degree) return failed(c, DEGREES, low, high);
    }
  }
  if (base_only) return true;
  uint count = rows;
  for (int degree = 1; degree <= sh_degree && count; ++degree) {
    count = begin_degree(c, rows, count, degree, degrees, weights);
    const uint coefficients = 2 * degree + 1;
    __global int *to = out + (size_t)(CHANNELS + 3 * (degree * degree - 1)) * stride;
    for (uint i = 0; i < coefficients && count; ++i) {
      const uint alphabet = 2 + CHANNELS + 3 * (degree - 1);
      if (!get_coefficient(c, alphabet, count, weights, coefficients * stride, to + (size_t)i * stride)) return false;
    }
  }
  for (uint lane = 0; lane < c->lanes && !c->counting; ++lane)
    if (c->states[lane] != RANS_FLOOR) return failed(c, LANES_END, 0, 0);
  return true;
}

// Decodes chunks, or counts the symbols of their channels (without positions). One kernel serves both directions, although each
// leaves the other's arrays alone: a second one would make a start without compiled kernels slower.
__kernel void code_chunks(
    const uint counting,               // 1: counts, 0: decodes
    const uint stride,                 // numbers of a plane: rows of the largest chunk, and 96 more
    const uint planes,                 // of codes: 11, and one for each SH coefficient and colour; decoding: 3 more
    const uint sh_degree,              // of the scene
    // Decoding:
    const uint word_stride,            // words of a chunk, with RANS_LANES spare ones behind those that it has
    const uint depth,                  // of the octree
    const uint base_only,              // 1: without SH
    // Counting:
    const uint log_most,               // symbols of a chunk
    const uint raw_most,               // room for its raw bytes
    const uint count_most,             // counts of all groups
    const uint batch_most,             // passes of all channels
    __global int *info,                // [chunks, INFO] what is wanted and what was found; counted: AT batches, WORDS raw bytes
    __global const int *records,       // [alphabets, RECORD]
    __global ulong *cells,             // [chunks, 2, stride]: the first of the two holds the rows' cells (decoding: afterwards)
    __global ushort *weights,          // [chunks, 8, stride]
    __global uchar *bytes,             // [chunks, BYTES, stride]
    __global int *ints,                // [chunks, INTS, stride]
    __global float *floats,            // [chunks, FLOATS, stride]
    __global int *codes,               // [chunks, planes, stride]: decoded x, y, z; base channels, SH by degree, colour, coefficient
    // Decoding:
    __global uint *states,             // [chunks, RANS_LANES]
    __global const ushort *words,      // [chunks, word_stride]
    __global const uchar *slots,       // [tables, 2^14] symbol of every slot
    __global const uint *entries,      // frequency and start of every symbol of every table
    // Counting:
    __global uchar *contexts,          // [chunks, log_most]
    __global uchar *symbols,           // [chunks, log_most]
    __global uchar *raw,               // [chunks, raw_most]
    __global uint *counts,             // [chunks, count_most]
    __global uint *batches)            // [chunks, batch_most, 3] alphabet, symbols, escapes
{
  const size_t i = get_global_id(0);
  __global int *about = info + i * INFO;
  const uint rows = about[ROWS];
  if (rows == 0) return;  // the host found the head of this chunk damaged
  Chunk c;
  c.stride = stride;
  c.records = records;
  c.bytes = bytes + i * BYTES * stride;
  c.ints = ints + i * INTS * stride;
  c.floats = floats + i * FLOATS * stride;
  c.status = GOOD;
  c.found = 0;
  c.wanted = 0;
  c.counting = counting;
  c.lanes = c.at = c.logged = c.raw_logged = c.batch_count = 0;
  __global int *to = codes + i * planes * stride;
  cells += i * 2 * stride;
  bool good = true;
  if (counting) {
    c.counts = counts + i * count_most;
    c.batches = batches + i * 3 * batch_most;
    c.log_contexts = contexts + i * log_most;
    c.log_symbols = symbols + i * log_most;
    c.log_raw = raw + i * raw_most;
    c.raw_most = raw_most;
    for (uint n = 0; n < count_most; ++n) c.counts[n] = 0;
    __global float *x = plane(&c, X), *y = plane(&c, Y), *z = plane(&c, Z);
    for (uint row = 0; row < rows; ++row) {
      const ulong cell = cells[row];
      x[row] = (float)every_third(cell >> 2);
      y[row] = (float)every_third(cell >> 1);
      z[row] = (float)every_third(cell);
    }
  } else {
    c.lanes = about[LANE_COUNT];
    c.states = states + i * RANS_LANES;
    c.words = words + i * word_stride;
    c.end = about[WORDS];
    c.slots = slots;
    c.entries = entries;
    good = get_positions(&c, rows, depth, cells, to);
    to += 3 * stride;
  }
  if (good) get_channels(&c, rows, (int)sh_degree, base_only, weights + i * 8 * stride, to);
  about[STATUS] = (int)c.status;
  about[FOUND] = (int)(c.found & 0xffffffff);
  about[FOUND_HIGH] = (int)(c.found >> 32);
  about[WANTED] = c.wanted;
  about[AT] = (int)(counting ? c.batch_count : c.at);
  if (counting) about[WORDS] = (int)c.raw_logged;
}
