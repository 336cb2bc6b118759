// Bit-packed codes -> float32 planes: low + code * step with two roundings, the same bits as NumPy.
// Twin: flexgs_edge.kernels.twins.dequantize

__kernel void dequantize(
    const uint count,                  // rows of the whole array
    const uint groups,                 // ranges a channel; group g holds rows [g * count / groups, (g + 1) * count / groups)
    const uint bits,                   // of a code, 1 to 16
    const uint plane_bytes,            // bytes of a channel's plane
    const uint first,                  // first row wanted
    const uint rows,                   // rows wanted
    const uint stride,                 // elements of an output plane
    __global const uchar *planes,      // [channels, plane_bytes] + 3 spare bytes; code of row i at bit i * bits, low bits first
    __global const float *low,         // [channels, groups]
    __global const float *step,        // [channels, groups]
    __global float *values)            // [channels, stride]
{
  const size_t channel = get_global_id(1);
  uint i = first + (uint)get_global_id(0) * DEQUANTIZE_ROWS;
  const uint end = min(i + DEQUANTIZE_ROWS, first + rows);
  __global const uchar *plane = planes + channel * plane_bytes;
  __global float *out = values + channel * stride - first;
  const uint keep = (1u << bits) - 1u;
  while (i < end) {
    const ulong group = (((ulong)i + 1) * groups - 1) / count;
    const uint group_end = min(end, (uint)((group + 1) * count / groups));
    const float lo = low[channel * groups + group], by = step[channel * groups + group];
    if (bits == 8) {
      for (; i < group_end; ++i) out[i] = lo + (float)plane[i] * by;
    } else {
      for (; i < group_end; ++i) {
        const ulong bit = (ulong)i * bits;
        const size_t at = (size_t)(bit >> 3);
        const uint window = (uint)plane[at] | (uint)plane[at + 1] << 8 | (uint)plane[at + 2] << 16;
        out[i] = lo + (float)((window >> (bit & 7)) & keep) * by;
      }
    }
  }
}
