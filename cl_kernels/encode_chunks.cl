// Codes rANS streams of version 2 chunks, one work-item a chunk: backwards through the batches, and through the rounds of each.
// Specification: flexgs_edge.codec.v2.rans.Encoder.

__kernel void encode_chunks(
    const uint most,                   // symbols of the largest chunk
    const uint batch_most,             // batches of a chunk at most
    __global const uint *about,        // [chunks, 2] lanes, batches
    __global const uint *sizes,        // [chunks, batch_most] symbols of every batch
    __global const uint *entries,      // [chunks, most] frequency and start of every symbol of all batches
    __global uint *states,             // [chunks, RANS_LANES]: the decoder's first ones afterwards
    __global ushort *words,            // [chunks, most]: written from the end
    __global uint *written)            // [chunks] words
{
  const size_t i = get_global_id(0);
  const uint lanes = about[2 * i], batches = about[2 * i + 1];
  __global uint *state = states + i * RANS_LANES;
  __global ushort *word = words + (i + 1) * most;
  sizes += i * batch_most;
  uint end = 0;
  for (uint b = 0; b < batches; ++b) end += sizes[b];
  for (uint lane = 0; lane < lanes; ++lane) state[lane] = RANS_FLOOR;
  __global const uint *entry = entries + i * most + end;
  for (uint b = batches; b-- > 0;) {
    for (uint left = sizes[b]; left;) {
      const uint size = (left - 1) % lanes + 1;
      for (uint lane = size; lane-- > 0;) {
        const uint e = *--entry, freq = e >> RANS_PRECISION;
        uint x = state[lane];
        const uint full = x >> (32 - RANS_PRECISION) >= freq;
        word[-1] = (ushort)x;
        word -= full;
        x >>= full << 4;
        state[lane] = x + x / freq * (RANS_TOTAL - freq) + (e & (RANS_TOTAL - 1));
      }
      left -= size;
    }
  }
  written[i] = (uint)(words + (i + 1) * most - word);
}
