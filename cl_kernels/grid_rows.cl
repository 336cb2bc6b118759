// Codes that code_chunks left on the device -> rows of INRIA's PLY in float32, one work-item a chunk.
// Specification: flexgs_edge.grid.values.from_grid. Every operation is rounded once and none is fused. The square root is taken in
// double, and rounds to the right float32.
#pragma OPENCL EXTENSION cl_khr_fp64 : enable

enum { POSITION_STEP, SCALE_STEP, ROTATION_STEP, OPACITY_STEP, COLOUR_STEPS };
enum { POSITION = 0, SCALE = 3, OPACITY = 6, COLOUR = 7, DEGREE = 10, ROTATION = 11, SH = 14 };
enum { NORMAL_COLUMN = 3, COLOUR_COLUMN = 6, SH_COLUMN = 9 };

inline void rgb(int y, int co, int cg, float luma, float chroma, __global float *red, uint stride) {
  const float brightness = (float)y * luma, half_orange = (float)co * chroma * 0.5f, half_green = (float)cg * chroma * 0.5f;
  const float rest = brightness - half_green;
  red[0] = rest + half_orange;
  red[stride] = brightness + half_green;
  red[2 * stride] = rest - half_orange;
}

__kernel void grid_rows(
    const uint stride,                 // numbers of a plane of codes
    const uint planes,                 // of codes a chunk
    const uint sh_degree,
    const uint columns,                // of a row: 17, and one for each SH coefficient and colour
    const uint table_rows,             // of a chunk's table
    const int low_x, const int low_y, const int low_z,  // position code of the first cell
    __global const int *rows,          // [chunks]
    __global const float *steps,       // position, scale, rotation, opacity; luma and chroma of degree 0 and every further one
    __global const int *codes,         // [chunks, planes, stride] as code_chunks leaves them
    __global float *table)             // [chunks, table_rows, columns]
{
  const size_t chunk = get_global_id(0);
  const uint count = rows[chunk], coefficients = (sh_degree + 1) * (sh_degree + 1) - 1;
  __global const int *code = codes + chunk * planes * stride;
  __global float *row = table + chunk * table_rows * columns;
  const int low[3] = {low_x, low_y, low_z};
  uint had[MAX_SH_DEGREE] = {0};  // rows so far that have the degree
  for (uint i = 0; i < count; ++i, row += columns) {
    for (uint axis = 0; axis < 3; ++axis) {
      row[axis] = (float)clamp(code[(POSITION + axis) * stride + i] + low[axis], -CODE_LIMIT, CODE_LIMIT) * steps[POSITION_STEP];
      row[NORMAL_COLUMN + axis] = 0.0f;
    }
    __global const int *colour = code + COLOUR * stride + i;
    rgb(colour[0], colour[stride], colour[2 * stride], steps[COLOUR_STEPS], steps[COLOUR_STEPS + 1], row + COLOUR_COLUMN, 1);
    const uint degrees = code[DEGREE * stride + i];
    __global float *sh = row + SH_COLUMN;
    for (uint degree = 1; degree <= sh_degree; ++degree) {
      const uint width = 2 * degree + 1, first = degree * degree - 1;
      if (degree > degrees) {
        for (uint k = first; k < first + width; ++k) sh[k] = sh[coefficients + k] = sh[2 * coefficients + k] = 0.0f;
        continue;
      }
      __global const int *band = code + (SH + 3 * first) * stride + had[degree - 1]++;
      const float luma = steps[COLOUR_STEPS + 2 * degree], chroma = steps[COLOUR_STEPS + 2 * degree + 1];
      for (uint k = 0; k < width; ++k)
        rgb(band[k * stride], band[(width + k) * stride], band[(2 * width + k) * stride], luma, chroma, sh + first + k, coefficients);
    }
    __global float *rest = sh + 3 * coefficients;
    rest[0] = (float)code[OPACITY * stride + i] * steps[OPACITY_STEP];
    for (uint axis = 0; axis < 3; ++axis) rest[1 + axis] = (float)code[(SCALE + axis) * stride + i] * steps[SCALE_STEP];
    const float x = (float)code[ROTATION * stride + i] * steps[ROTATION_STEP];
    const float y = (float)code[(ROTATION + 1) * stride + i] * steps[ROTATION_STEP];
    const float z = (float)code[(ROTATION + 2) * stride + i] * steps[ROTATION_STEP];
    const float square = 1.0f - ((x * x + y * y) + z * z);
    rest[4] = (float)sqrt((double)(square > 0.0f ? square : 0.0f));
    rest[5] = x;
    rest[6] = y;
    rest[7] = z;
  }
}
