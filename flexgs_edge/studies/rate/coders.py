"""Sizes of a grid scene in other coders. Quality need not be measured: the same integers decode to the same scene."""

from __future__ import annotations

import lzma
import math
import zlib
from collections.abc import Callable, Iterator

import numpy as np

from flexgs_edge.codec.v2.encode import encode_grid
from flexgs_edge.grid.grid_scene import GridScene

LENGTH_BYTES = 4
"""Bytes for the length of a coded plane. Its first and least numbers are not counted, in favour of the other coders."""


def coder_sizes(grid: GridScene, size: int) -> dict[str, int]:
    """Bytes of the file by name of the coder; the header stays the same.

    Parameters
    ----------
    grid : GridScene
        The scene.
    size : int
        Bytes of the finished file.
    """
    encoded = encode_grid(grid)
    rest = size - len(encoded.model.to_bytes()) - sum(map(len, encoded.streams()))
    return {name: rest + coded for name, coded in plane_sizes(grid).items()}


def plane_sizes(grid: GridScene) -> dict[str, int]:
    """Bytes of all integers by name of the coder.

    Every plane of integers is coded alone, either as it is or as differences from row to row; the smaller one counts.
    `fixed bits` has no differences. For zlib and lzma, integers are split into planes of bytes, as many as the largest
    integer needs. `order-0 entropy` is a bound for all coders that code each integer by itself, without their tables.
    """
    sizes = dict.fromkeys(("order-0 entropy", *_COMPRESS, "fixed bits"), 0.0)
    for plane in _planes(grid):
        both = plane, np.diff(plane, prepend=plane[:1])
        sizes["order-0 entropy"] += min(map(_entropy_bytes, both))
        for name, compress in _COMPRESS.items():
            sizes[name] += LENGTH_BYTES + min(len(compress(_byte_planes(values))) for values in both)
        sizes["fixed bits"] += math.ceil(len(plane) * int(np.ptp(plane)).bit_length() / 8) if len(plane) else 0
    return {name: math.ceil(found) for name, found in sizes.items()}


def _planes(grid: GridScene) -> Iterator[np.ndarray]:
    """Every plane of integers ([n] i64) that makes up the grid."""
    for planes in (grid.position, grid.scale, grid.rotation, grid.opacity[None], grid.dc, *grid.sh):
        yield from planes.astype(np.int64)
    if grid.sh_degree:
        yield grid.sh_degrees.astype(np.int64)


def _entropy_bytes(values: np.ndarray) -> float:
    counts = np.unique(values, return_counts=True)[1]
    return float(-(counts * np.log2(counts / max(len(values), 1))).sum()) / 8


def _byte_planes(values: np.ndarray) -> bytes:
    if not len(values):
        return b""
    shifted = (values - values.min()).astype("<u8")
    width = max(-(-int(shifted.max()).bit_length() // 8), 1)
    shuffled: bytes = shifted.view(np.uint8).reshape(-1, 8)[:, :width].T.tobytes()
    return shuffled


def _lzma(data: bytes) -> bytes:
    # The preset's own window of 64 MiB would take much memory and time even for a few bytes.
    window = {"id": lzma.FILTER_LZMA2, "preset": 9, "dict_size": max(len(data), 4096)}
    return lzma.compress(data, lzma.FORMAT_RAW, filters=[window])


_COMPRESS: dict[str, Callable[[bytes], bytes]] = {"lzma": _lzma, "zlib": lambda data: zlib.compress(data, 9)}
