"""Write `.spz` files, versions 3 and 4."""

import math
import zlib
from collections.abc import Callable, Iterator
from typing import BinaryIO

import numpy as np
import zstandard
from deflate import gzip_compress

from flexgs_edge.io import spz
from flexgs_edge.io.codes import nearest, opacities, without_largest
from flexgs_edge.io.reading import Writing
from flexgs_edge.scene.source import SceneSource

SH_STEP, FINE_SH_STEP = 8, 2
"""Steps of the SH codes, in units of 1/128; the reference program takes 16 above degree 1, which causes nearly all of its loss.
The finer one is for SH that lie on a grid: elsewhere it costs more bytes than it is worth. docs/results/tuning.md#sh_step"""
_FEW_BYTES = 1.25  # Most that the bytes of SH may grow by a finer step
_TRIED_ROWS = 1 << 14
_LEAST_BITS = 12  # Bits behind the point that other writers always take
_BITS_BELOW_SIZE = 5
_CHUNK_ROWS = 1 << 14  # Fixed, since zstd's output may depend on the pieces that it gets
_GZIP_LEVEL = 11  # Of libdeflate: 5 % smaller than the best of zlib, in half the time
_ZSTD_LEVEL = 19  # 7 % smaller than the reference program's 12


def write_spz(file: BinaryIO, source: SceneSource, writing: Writing) -> None:
    """Write a scene in RUB as a `.spz`; see `Format.writer`."""
    flags = spz.ANTIALIASED if writing.antialiased else 0
    header = spz.SpzHeader(writing.spz_version, source.count, source.sh_degree, fraction_bits(source), flags)
    if header.version < spz.FIRST_PLAIN:
        arrays = (codes for field in header.widths for codes in _array(source, header, field))
        file.write(gzip_compress(b"".join((header.packed, *arrays)), _GZIP_LEVEL))
        return
    widths = header.widths
    place = spz.PLAIN_HEADER.size
    head = (spz.MAGIC, header.version, header.count, header.sh_degree, header.fraction_bits, flags, len(widths), place)
    file.write(spz.PLAIN_HEADER.pack(*head) + bytes(spz.SIZES.size * len(widths)))
    table = b""
    for field, width in widths.items():
        start, size = file.tell(), width * source.count
        packer = zstandard.ZstdCompressor(level=_ZSTD_LEVEL, threads=0).compressobj(size=size)
        for codes in _array(source, header, field):
            file.write(packer.compress(codes))
        file.write(packer.flush())
        table += spz.SIZES.pack(file.tell() - start, size)
    file.seek(place)
    file.write(table)


def fraction_bits(source: SceneSource) -> int:
    """Bits behind the point of coordinates.

    The step is at most 1/32 of the median size of the Gaussians, as the step of their log-scales is 1/16, and at most that of
    12 bits. A finer one costs bytes and shows nothing. The largest coordinate must fit, which may leave fewer bits.
    """
    largest, sizes = 0.0, np.zeros(256, np.int64)
    for rows in source.chunks(_CHUNK_ROWS):
        planes = source.read(rows, ["means", "log_scales"])
        largest = max(largest, float(np.abs(planes["means"]).max(initial=0)))
        middle = np.median(planes["log_scales"], axis=0, keepdims=True)
        sizes += np.bincount(_scale_codes(middle)[:, 0], minlength=256)
    median = int(np.searchsorted(np.cumsum(sizes), (source.count + 1) // 2)) / spz.SCALE_STEPS - spz.SCALE_OFFSET
    wanted = max(_LEAST_BITS, math.ceil(_BITS_BELOW_SIZE - median / math.log(2)))
    room = 23 - math.frexp(largest)[1]
    if round(math.ldexp(largest, room)) > spz.POSITION_LIMIT:
        room -= 1
    return max(0, min(wanted, room, spz.MAX_FRACTION_BITS))


def _array(source: SceneSource, header: spz.SpzHeader, field: str) -> Iterator[bytes]:
    """The codes of one field, chunk by chunk."""
    step = _sh_step(source) if field == "sh_rest" else 0
    for rows in source.chunks(_CHUNK_ROWS):
        values = source.read(rows, [field])[field]
        if field == "means":
            codes = position_codes(values, header.fraction_bits)
        else:
            codes = _sh_rows(values, step) if step else _CODES[field](values)
        yield codes.tobytes()


def position_codes(means: np.ndarray, bits: int) -> np.ndarray:
    """[n, 9] u8: coordinates [3, n] as integers of 24 bits."""
    fixed = np.rint(np.ldexp(means.T.astype(np.float64), bits))
    words = np.clip(fixed, -spz.POSITION_LIMIT, spz.POSITION_LIMIT).astype("<i4", order="C")
    return words.view(np.uint8).reshape(-1, 3, 4)[:, :, :3].reshape(-1, 9)


def sh_codes(values: np.ndarray, step: int = SH_STEP) -> np.ndarray:
    """Bytes of SH coefficients, as int64; 128 stands for zero.

    >>> sh_codes(np.array([0.0, 0.07, -2.0, 5.0])).tolist()
    [128, 136, 0, 248]
    """
    steps = np.clip(np.rint(values.astype(np.float64) * (128 / step)), -128 // step, (255 - 128) // step)
    return 128 + step * steps.astype(np.int64)


def _sh_rows(planes: np.ndarray, step: int) -> np.ndarray:
    """[n, 3 * K] u8: colour channels vary fastest in the file, and slowest in `planes`."""
    codes = sh_codes(planes.reshape(3, len(planes) // 3, -1).transpose(2, 1, 0), step)
    return codes.astype(np.uint8)


def _sh_step(source: SceneSource) -> int:
    """The step of SH codes that suits a scene, from what some of its rows take."""
    rows = np.arange(0, source.count, -(-source.count // _TRIED_ROWS))
    planes = source.read(rows, ["sh_rest"])["sh_rest"]
    coarse, fine = (len(zlib.compress(_sh_rows(planes, step).tobytes(), 1)) for step in (SH_STEP, FINE_SH_STEP))
    return FINE_SH_STEP if fine <= _FEW_BYTES * coarse else SH_STEP


def _scale_codes(log_scales: np.ndarray) -> np.ndarray:
    return nearest((log_scales.T.astype(np.float64) + spz.SCALE_OFFSET) * spz.SCALE_STEPS)


def smallest_three(quats: np.ndarray) -> np.ndarray:
    """[n] u32: unit quaternions [4, n] w x y z without their largest component, 10 bits for each of the others."""
    largest, others = without_largest(quats[[1, 2, 3, 0]])
    sizes = nearest(np.abs(others) * (spz.ROTATION_MASK / math.sqrt(0.5)), spz.ROTATION_MASK)
    parts = sizes | np.where(others < 0, np.uint32(spz.ROTATION_MASK + 1), np.uint32(0))
    return largest.astype(np.uint32) << 30 | parts[0] << 20 | parts[1] << 10 | parts[2]


_CODES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "opacity_logits": lambda planes: nearest(255 * opacities(planes.T)),
    "sh_dc": lambda planes: nearest((planes.T.astype(np.float64) * spz.COLOUR_SCALE + 0.5) * 255),
    "log_scales": _scale_codes,
    "quats": lambda planes: smallest_three(planes).astype("<u4"),
}  # Codes of planes, row by row, for all fields but positions and SH
