// Decodes version 2 chunks (docs/format.md), or counts their symbols, one work-item a chunk: octree, repeats, and every channel
// pass by pass.
// Specification: flexgs_edge.codec.v2 (walk, contexts, groups, ports, rans), with the same numbers to the last bit. Sums are
// doubles, which hold all of their integers exactly in any order. Divisions are rounded as in float32.
//
// Rows lie in the order of the passes, so that each pass reads and writes contiguous memory: row (2j + 1) 2^k of n is at
// place((n, k)) + j. Only `known` is in row order: the rows decoded so far, which every pass interleaves with its own.
//
// A damaged stream gives a status, never an access out of bounds. The host checks that contexts are below the counts, and tables
// have the right size. RANS_LANES spare words follow the words, and nodes are counted before they are written.
#pragma OPENCL EXTENSION cl_khr_fp64 : enable

#if W == 1
typedef double DW;
#define LOAD(p, i) ((p)[i])
#define STORE(v, p, i) ((p)[i] = (v))
#define AS(type, x) ((type)(x))
#define AS_U(x) as_uint(x)
typedef ulong UL1;
#else
typedef CAT(double, W) DW;
typedef ulong4 UL4;
typedef ulong8 UL8;
typedef ulong16 UL16;
#define AS_U(x) CAT(as_uint, W)(x)
#define LOAD(p, i) CAT(vload, W)(0, (p) + (i))
#define STORE(v, p, i) CAT(vstore, W)(v, 0, (p) + (i))
#define AS(type, x) CAT(CAT(convert_, type), W)(x)
#endif

#define PAD 16  // spare numbers before the rows that neighbours are looked up in
#define TERMS 13
#define FETCH_ROWS 4096  // a batch of so many rows looks at most lines of the tables
#define ROUND 6755399441055744.0  // 1.5 * 2^52

// Places in the record of an alphabet.
enum {
  START_LOW, START_HIGH, SHIFT, SYMBOLS, MEAN_CUTS, ERROR_CUTS, RESIDUAL, FEATURES,
  MEAN_CUT = 8, ERROR_CUT = 23, SLOT = 38, ENTRY = SLOT + 64, MEAN_WEIGHT = ENTRY + 64, ERROR_WEIGHT = MEAN_WEIGHT + 17,
  FIRST_SLOT = ERROR_WEIGHT + 17, SLOTS, FIRST_COUNT, RECORD
};
// Places in the info record of a chunk.
enum { ROWS, LANE_COUNT, WORDS, STATUS, FOUND, FOUND_HIGH, WANTED, AT, INFO };
enum { GOOD, NO_WORDS, NO_CHILDREN, NODES, REPEATS, CODES, DEGREES, LANES_END, NO_ROOM };
// Work planes of a chunk.
enum { X, Y, Z, KNOWN, OTHER = KNOWN + 1, VALUE, SPARE, NEAR, NEAR_SH, BASE, STEADY = BASE + 21, BEFORE = STEADY + 7, FLOATS = BEFORE + 7 };
enum { ROUNDED, RAW, SUBSET, CAME_FROM, INTS };
enum { CONTEXT, SYMBOL, CHILDREN, CHILDREN_NEXT, BYTES };
// Base channels in order, and the features of those that predict others.
enum { OPACITY = 3, DEGREE = 7, CHANNELS = 11 };

typedef struct {
  uint lanes, stride;
  __global uint *states;
  __global const ushort *words;
  uint at, end;
  __global const int *records;
  __global const uchar *slots;
  __global const uint *entries;
  __global uchar *bytes;
  __global int *ints;
  __global float *floats;
  uint clipped;
  // For counting: symbols of all batches, raw bytes, and alphabet, size and escapes of every batch.
  bool counting;
  __global uint *counts, *batches;
  __global uchar *log_contexts, *log_symbols, *log_raw;
  uint logged, raw_logged, raw_most, batch_count;
  uint status;
  long found;
  int wanted;
} Chunk;

typedef struct {
  uint count;
  __global const float *values[TERMS];
  uint places[TERMS];
} Terms;

inline void add_term(Terms *terms, __global const float *values, uint place) {
  terms->values[terms->count] = values;
  terms->places[terms->count++] = place;
}

inline __global float *plane(const Chunk *c, uint which) { return c->floats + (size_t)which * c->stride; }

inline bool failed(Chunk *c, uint status, long found, int wanted) {
  c->status = status;
  c->found = found;
  c->wanted = wanted;
  return false;
}

inline FW divide(FW a, FW b) { return AS(float, AS(double, a) / AS(double, b)); }
inline FW one_if(IW mask) { return pick(mask, (FW)1.0f, (FW)0.0f); }

// Floor of |x| < 2^51.
inline DW round_down_wide(DW x) {
  DW r = (x + (DW)ROUND) - (DW)ROUND;
  return r - ((r > x) ? (DW)1.0 : (DW)0.0);
}

// 1 for a state below the floor. Computed without a branch: one in eight states is empty, which no processor can predict.
inline uint is_empty(uint state) { return (state / RANS_FLOOR - 1) >> 31; }

// Decodes one batch: a symbol for each of `count` contexts.
inline bool get_batch(Chunk *c, uint alphabet, uint count) {
  __global const int *slot_of = c->records + alphabet * RECORD + SLOT, *entry_of = slot_of + (ENTRY - SLOT);
  __global const uchar *slots = c->slots;
  __global const uint *entries = c->entries;
  __global const ushort *words = c->words;
  const uint lanes = c->lanes, end = c->end;
  uint at = c->at;
  // Fetch the tables, which the predictions have pushed out of the near caches.
  if (count >= FETCH_ROWS) {
    __global const int *record = c->records + alphabet * RECORD;
    for (int slot = 0; slot < record[SLOTS]; slot += 64) FETCH(slots + record[FIRST_SLOT] + slot);
  }
  for (uint first = 0; first < count; first += lanes) {
    __global uint *states = c->states;
    __global const uchar *context = c->bytes + (size_t)CONTEXT * c->stride + first;
    __global uchar *symbol = c->bytes + (size_t)SYMBOL * c->stride + first;
    const uint size = min(lanes, count - first);
    for (uint lane = 0; lane < size; ++lane) {
      const uint state = states[lane], slot = state & (RANS_TOTAL - 1), at_table = context[lane];
      const uint found = slots[(uint)slot_of[at_table] + slot];
      const uint entry = entries[(uint)entry_of[at_table] + found];
      const uint next = (entry >> RANS_PRECISION) * (state >> RANS_PRECISION) + slot - (entry & (RANS_TOTAL - 1));
      const uint empty = is_empty(next);
      states[lane] = next << (empty << 4) | (words[at] & -empty);
      at += empty;
      symbol[lane] = (uchar)found;
    }
    if (at > end) return failed(c, NO_WORDS, 0, 0);
  }
  c->at = at;
  return true;
}

// Decodes `count` numbers of `bits` bits, all values equally likely.
inline bool get_raw(Chunk *c, uint count, uint bits, __global uint *out) {
  for (uint i = 0; i < count; ++i) out[i] = 0;
  for (uint from = 0; from < bits; from += 8) {
    const uint low = RANS_PRECISION - min(bits - from, 8u);
    for (uint first = 0; first < count; first += c->lanes) {
      const uint size = min(c->lanes, count - first);
      for (uint lane = 0; lane < size; ++lane) {
        const uint state = c->states[lane], slot = state & (RANS_TOTAL - 1);
        const uint next = ((state >> RANS_PRECISION) << low) + (slot & ((1u << low) - 1));
        const uint empty = is_empty(next);
        c->states[lane] = next << (empty << 4) | (c->words[c->at] & -empty);
        c->at += empty;
        out[first + lane] |= slot >> low << from;
      }
      if (c->at > c->end) return failed(c, NO_WORDS, 0, 0);
    }
  }
  return true;
}

inline uint passes(uint rows) {
  const uint blocks = (rows - 1) / COARSE_ROWS;
  return blocks ? 32 - clz(blocks) : 0;
}
// The place of the rows at odd multiples of 2^k, which is the number of rows before them; and the number of these rows.
inline uint begin_of(uint rows, uint k) { return ((rows - 1) >> (k + 1)) + 1; }
inline uint size_of(uint rows, uint k) { return (((rows - 1) >> k) + 1) >> 1; }
inline uint place_of(uint row, uint rows, uint top) {
  const uint k = popcount((row & -row) - 1);
  return k >= top ? row >> top : begin_of(rows, k) + (row >> (k + 1));
}

inline void repeat_ends(__global float *known, uint count) {
  for (int i = 1; i < 4; ++i) known[-i] = known[0];
  for (uint i = 0; i < 4; ++i) known[count + i] = known[count - 1];
}

// Weights of the neighbours, and distance features, of `count` of the rows, which `subset` lists.
inline void plan_passes(const Chunk *c, uint count, uint reach, __global ushort *weights, __global float *near) {
  __global const int *subset = c->ints + (size_t)SUBSET * c->stride;
  __global float *known[3] = {plane(c, KNOWN) + PAD, plane(c, OTHER) + PAD, plane(c, VALUE) + PAD};
  __global float *here[3] = {plane(c, SPARE), (__global float *)(c->ints), (__global float *)(c->ints + c->stride)};
  const uint top = passes(count);
  for (uint i = 0; i <= (count - 1) >> top; ++i) near[i] = 0.0f;
  for (int k = (int)top - 1; k >= 0; --k) {
    const uint before = begin_of(count, k), size = size_of(count, k);
    for (int axis = 0; axis < 3; ++axis) {
      __global const float *points = plane(c, axis);
      __global float *to = known[axis], *at = here[axis];
      for (uint j = 0; j < before; ++j) to[j] = points[subset[j << (k + 1)]];
      for (uint j = 0; j < size; ++j) at[j] = points[subset[(2 * j + 1) << k]];
      repeat_ends(to, before);
    }
    for (uint j = 0; j < size; j += W) {
      FW square[8], least = (FW)0.0f, total = (FW)0.0f;
      const FW x = LOAD(here[0], j), y = LOAD(here[1], j), z = LOAD(here[2], j);
      for (uint i = 0; i < 2 * reach; ++i) {
        const size_t there = j + i + 1;
        const FW dx = LOAD(known[0] - reach, there) - x, dy = LOAD(known[1] - reach, there) - y;
        const FW dz = LOAD(known[2] - reach, there) - z;
        const FW d = dx * dx + dy * dy + dz * dz + (FW)1.0f;
        least = i ? smaller(d, least) : d;
        square[i] = divide((FW)1.0f, d);
        total += square[i];
      }
      const FW share = divide((FW)256.0f, total);
      for (uint i = 0; i < 2 * reach; ++i) {
        const FW weight = (square[i] * share + (FW)EXP2_MAGIC) - (FW)EXP2_MAGIC;
        STORE(AS(ushort, AS(int, weight)), weights + (size_t)i * c->stride, before + j);
      }
      STORE(AS(float, (AS_I(least) >> 23) - 126) * (FW)256.0f, near, before + j);
    }
  }
}

// Contexts of a pass; for groups of residuals, also the base to add to the symbols.
inline void predict(const Chunk *c, uint alphabet, const Terms *terms, uint begin, uint size, uint reach, __global const ushort *weights,
                    __global const float *known, __global float *mean_out) {
  __global const int *record = c->records + alphabet * RECORD;
  __global uchar *context = c->bytes + (size_t)CONTEXT * c->stride;
  __global int *rounded = c->ints + (size_t)ROUNDED * c->stride;
  const uint features = record[FEATURES], mean_cuts = record[MEAN_CUTS], error_cuts = record[ERROR_CUTS];
  double to_mean[TERMS], to_error[TERMS];
  for (uint i = 0; i < terms->count; ++i) {
    to_mean[i] = record[MEAN_WEIGHT + terms->places[i]];
    to_error[i] = record[ERROR_WEIGHT + terms->places[i]];
  }
  for (uint j = 0; j < size; j += W) {
    DW mean = (DW)(256.0 * record[MEAN_WEIGHT + features]), error = (DW)(256.0 * record[ERROR_WEIGHT + features]);
    if (reach) {
      FW weight[8], there[8], m = (FW)0.0f, spread = (FW)0.0f;
      for (uint i = 0; i < 2 * reach; ++i) {
        weight[i] = AS(float, LOAD(weights + (size_t)i * c->stride, begin + j));
        there[i] = LOAD(known - reach, j + i + 1);
        m += weight[i] * there[i];
      }
      const FW middle = round_down(m * (FW)(1.0f / 256.0f) + (FW)0.5f);
      for (uint i = 0; i < 2 * reach; ++i) spread += weight[i] * fabs(there[i] - middle);
      const DW wide = AS(double, m), spread_wide = AS(double, spread);
      mean += (DW)(double)record[MEAN_WEIGHT] * wide + (DW)(double)record[MEAN_WEIGHT + 1] * spread_wide;
      error += (DW)(double)record[ERROR_WEIGHT] * wide + (DW)(double)record[ERROR_WEIGHT + 1] * spread_wide;
      if (mean_out) STORE(m, mean_out, begin + j);
    }
    for (uint i = 0; i < terms->count; ++i) {
      const DW value = AS(double, LOAD(terms->values[i], begin + j));
      mean += (DW)to_mean[i] * value;
      error += (DW)to_error[i] * value;
    }
    // The error may leave the range of int, where its cuts lie. Below that range, no cut is reached.
    DW level = round_down_wide(error * (DW)(1.0 / 1024.0));
    level = (level > (DW)2147483647.0) ? (DW)2147483647.0 : level;
    FW inside = (FW)1.0f;
    if (error_cuts && record[ERROR_CUT] == INT_MIN) inside = AS(float, (level < (DW)-2147483648.0) ? (DW)0.0 : (DW)1.0);
    level = (level < (DW)-2147483648.0) ? (DW)-2147483648.0 : level;
    const IW error_level = AS(int, level);
    // Counted in floats, since Oclgrind takes the truth of a vector for 255.
    FW place = (FW)0.0f;
    for (uint i = 0; i < error_cuts; ++i) place += one_if(MASK(error_level >= (IW)record[ERROR_CUT + i]));
    place *= inside;
    FW above = (FW)0.0f;
    if (record[RESIDUAL]) {
      const DW nearest = round_down_wide(mean * (DW)(1.0 / 65536.0) + (DW)0.5);
      STORE(AS(int, nearest), rounded, j);
      above = one_if(MASK(AS(int, mean - nearest * (DW)65536.0) >= (IW)0));
    } else {
      const IW mean_level = AS(int, round_down_wide(mean * (DW)(1.0 / 4096.0)));
      for (uint i = 0; i < mean_cuts; ++i) above += one_if(MASK(mean_level >= (IW)record[MEAN_CUT + i]));
    }
    place += above * (FW)(float)(error_cuts + 1);
    STORE(AS(uchar, AS(int, place)), context, j);
  }
}

inline FW magnitude(FW x) { return AS_F(AS_I(x) & (IW)0x7fffffff); }

// Codes and values of a pass, from its symbols and its raw bits if there are any.
inline bool finish_pass(Chunk *c, uint alphabet, uint size) {
  __global const int *record = c->records + alphabet * RECORD;
  __global const uchar *symbol = c->bytes + (size_t)SYMBOL * c->stride;
  __global int *rounded = c->ints + (size_t)ROUNDED * c->stride;
  __global uint *raw = (__global uint *)(c->ints + (size_t)RAW * c->stride);
  __global float *value = plane(c, VALUE) + PAD;
  const long start = (long)record[START_HIGH] << 32 | (uint)record[START_LOW];
  const int last = record[SYMBOLS] - 1, shift = record[SHIFT], keep = record[RESIDUAL] ? -1 : 0;
  uint escapes = 0;
  for (uint j = 0; j < size; ++j) escapes += symbol[j] == last;
  if (!escapes && !shift && start > -(1 << 29) && start < 1 << 29) {
    IW wrong = (IW)0, clipped = (IW)0;
    for (uint j = 0; j < size; j += W) {
      const IW code = AS(int, LOAD(symbol, j)) + (IW)(int)start + (LOAD(rounded, j) & (IW)keep);
      wrong |= MASK((code > (IW)CODE_LIMIT) | (code < (IW)-CODE_LIMIT)) & MASK(LANE_INDEX < (IW)(int)(size - j));
      FW v = TO_F(code);
      clipped |= MASK((code > (IW)(int)VALUE_LIMIT) | (code < (IW)(int)-VALUE_LIMIT));
      v = larger(smaller(v, (FW)VALUE_LIMIT), (FW)-VALUE_LIMIT);
      STORE(code, rounded, j);
      STORE(v, value, j);
    }
    c->clipped |= ANY(clipped) ? 1 : 0;
    return ANY(wrong) ? failed(c, CODES, 0, alphabet) : true;
  }
  const uint plain = size - escapes;
  if (shift && !get_raw(c, plain, shift, raw)) return false;
  if (!get_raw(c, escapes, 32, raw + plain)) return false;
  uint next = 0, escape = plain, wrong = 0;
  c->clipped = 1;
  for (uint j = 0; j < size; ++j) {
    const bool escaped = symbol[j] == last;
    const long more = escaped ? (long)(int)raw[escape] : ((long)symbol[j] << shift) + (shift ? raw[next] : 0u);
    const long code = start + (rounded[j] & keep) + more;
    escape += escaped;
    next += !escaped;
    wrong |= code > CODE_LIMIT || code < -CODE_LIMIT;
    rounded[j] = (int)code;
    value[j] = (float)clamp(code, (long)-VALUE_LIMIT, (long)VALUE_LIMIT);
  }
  return wrong ? failed(c, CODES, 0, alphabet) : true;
}

// Symbols of a pass from its codes; counts and logs them.
inline bool count_pass(Chunk *c, uint alphabet, uint size, __global const int *from, uint step) {
  __global const int *record = c->records + alphabet * RECORD;
  __global const uchar *context = c->bytes + (size_t)CONTEXT * c->stride;
  __global const int *rounded = c->ints + (size_t)ROUNDED * c->stride;
  __global float *value = plane(c, VALUE) + PAD;
  __global uchar *contexts = c->log_contexts + c->logged, *symbols = c->log_symbols + c->logged;
  __global uint *counts = c->counts + record[FIRST_COUNT];
  const long start = (long)record[START_HIGH] << 32 | (uint)record[START_LOW];
  const int last = record[SYMBOLS] - 1, shift = record[SHIFT], keep = record[RESIDUAL] ? -1 : 0;
  uint escapes = 0;
  for (uint j = 0; j < size; ++j) {
    const int code = from[j << step];
    const long symbol = (code - start - (rounded[j] & keep)) >> shift;
    const bool escaped = symbol < 0 || symbol >= last;
    const uint noted = escaped ? (uint)last : (uint)symbol;
    escapes += escaped;
    contexts[j] = context[j];
    symbols[j] = (uchar)noted;
    ++counts[context[j] * (uint)(last + 1) + noted];
    value[j] = clamp((float)code, -VALUE_LIMIT, VALUE_LIMIT);
  }
  __global uint *batch = c->batches + 3 * c->batch_count++;
  batch[0] = alphabet;
  batch[1] = size;
  batch[2] = escapes;
  c->logged += size;
  if (!shift && !escapes) return true;
  const uint plain = size - escapes, pieces = (shift + 7) / 8;
  if (plain * pieces + 4 * escapes > c->raw_most - c->raw_logged) return failed(c, NO_ROOM, 0, 0);
  __global uchar *raw = c->log_raw + c->raw_logged, *far = raw + plain * pieces;
  c->raw_logged += plain * pieces + 4 * escapes;
  for (uint j = 0; j < size; ++j) {
    const long offset = from[j << step] - start - (rounded[j] & keep);
    const bool escaped = symbols[j] == last;
    for (uint piece = 0; piece < (escaped ? 4 : pieces); ++piece) {
      const uint bits = escaped ? 8 : min(shift - 8 * (int)piece, 8);
      (escaped ? far + piece * escapes : raw + piece * plain)[0] = (uchar)(offset >> (8 * piece) & ((1 << bits) - 1));
    }
    if (escaped)
      ++far;
    else
      ++raw;
  }
  return true;
}

// Merges the known rows with those of the pass, by turns.
inline void interleave(__global const float *known, uint before, __global const float *value, uint size, __global float *to) {
  for (uint j = 0; j < size; j += W) {
    const CAT(UL, W) both = AS(ulong, AS_U(LOAD(known, j))) | AS(ulong, AS_U(LOAD(value, j))) << 32;
    STORE(both, (__global ulong *)to, j);
  }
  if (before > size) to[2 * size] = known[size];
}

inline void interleave_codes(__global const float *known, uint before, __global const int *code, uint size, __global int *to) {
  for (uint j = 0; j < size; j += W) {
    const CAT(UL, W) both = AS(ulong, AS_U(AS(int, LOAD(known, j)))) | AS(ulong, AS_U(LOAD(code, j))) << 32;
    STORE(both, (__global ulong *)to, j);
  }
  if (before > size) to[2 * size] = (int)known[size];
}

// Codes one channel of `count` rows. If wanted, it writes in the order of the passes: values and means of the neighbours in 1/256,
// and the distance of both (magnitudes if there are no means).
inline bool get_channel(Chunk *c, uint alphabet, uint count, uint reach, __global const ushort *weights, const Terms *terms,
                        __global float *value_out, __global float *mean_out, __global float *away_out, __global int *out) {
  const uint top = passes(count);
  bool scattered = false;
  c->clipped = 0;
  __global float *known = plane(c, KNOWN) + PAD, *other = plane(c, OTHER) + PAD;
  __global const float *value = plane(c, VALUE) + PAD;
  __global const int *code = c->ints + (size_t)ROUNDED * c->stride;
  for (int k = (int)top; k >= 0; --k) {
    const bool first = k == (int)top;
    const uint begin = first ? 0 : begin_of(count, k), size = first ? ((count - 1) >> top) + 1 : size_of(count, k);
    if (!first) repeat_ends(known, begin);
    // Called in one place only, since compilers copy its body to every call.
    predict(c, alphabet, terms, begin, size, first ? 0 : reach, weights, known, mean_out);
    const uint offset = first ? 0 : 1 << k, step = first ? k : k + 1;
    if (c->counting) {
      if (!count_pass(c, alphabet, size, out + offset, step)) return false;
    } else if (!get_batch(c, alphabet, size) || !finish_pass(c, alphabet, size)) {
      return false;
    }
    if (away_out) {
      for (uint j = 0; j < size; j += W) {
        const FW v = LOAD(value, j) * (FW)256.0f;
        if (value_out) STORE(v, value_out, begin + j);
        if (first && mean_out) STORE(v, mean_out, j);
        STORE(magnitude(mean_out ? v - LOAD(mean_out, begin + j) : v), away_out, begin + j);
      }
    }
    // Codes get into row order together with their values, except for codes that values do not hold.
    if (c->clipped && !scattered && !c->counting) {
      for (uint j = 0; j < begin; ++j) out[j << (k + 1)] = (int)known[j];
      scattered = true;
    }
    for (uint j = 0; j < size && scattered; ++j) out[offset + (j << step)] = code[j];
    if (!k && !scattered && !c->counting) {
      if (first)
        for (uint j = 0; j < size; ++j) out[j] = code[j];
      else
        interleave_codes(known, begin, code, size, out);
    }
    if (first) {
      for (uint j = 0; j < size; ++j) known[j] = value[j];
    } else if (k) {
      interleave(known, begin, value, size, other);
      __global float *swap = known;
      known = other;
      other = swap;
    }
  }
  return true;
}

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
