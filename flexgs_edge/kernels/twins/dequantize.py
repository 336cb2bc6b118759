"""Twin of `cl_kernels/dequantize.cl`."""

import numpy as np

from flexgs_edge.kernels.twins.arithmetic import Array, Size


def dequantize(
    size: Size, count: int, groups: int, bits: int, plane_bytes: int, first: int, rows: int, stride: int, planes: Array,
    low: Array, step: Array, values: Array,
) -> None:  # fmt: skip
    """Dequantize rows [first, first + rows) of every channel into `values` ([channels, stride])."""
    row = np.arange(first, first + rows, dtype=np.int64)
    group = ((row + 1) * groups - 1) // count
    at, shift = row * bits >> 3, row * bits & 7
    for channel in range(values.shape[0]):
        plane = planes[channel * plane_bytes :]
        window = plane[at].astype(np.uint32) | plane[at + 1].astype(np.uint32) << np.uint32(8)
        window |= plane[at + 2].astype(np.uint32) << np.uint32(16)
        codes = (window >> shift.astype(np.uint32)) & np.uint32((1 << bits) - 1)
        values[channel, :rows] = low[channel, group] + codes.astype(np.float32) * step[channel, group]
