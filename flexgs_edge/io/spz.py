"""Write the SH of `.spz` files again, with a finer step than the converter's.

The format stores each coefficient as a byte, (code - 128) / 128, and leaves the rounding to the writer. The converter
keeps 5 bits of degree 1 and 4 bits of the others, which causes nearly all of the loss. SH come last in the stream, so
we copy the stream and replace them. Layout: magic, version, count, SH degree, 12 bits behind the point, flags and a
zero (16 bytes); then arrays with these bytes a Gaussian: positions 9, opacity 1, colour 3, scales 3, rotation 3
(version 2) or 4 (version 3), and SH by Gaussian, coefficient, channel. All of it is one gzip stream.
"""

from __future__ import annotations

import gzip
import os
import struct
import zlib
from pathlib import Path

import numpy as np

from flexgs_edge.errors import InputError
from flexgs_edge.scene.source import SceneSource

SH_STEP = 8
"""Step of the codes, in units of 1/128: half of the converter's own step above degree 1. A smaller step costs more
bytes than it is worth: docs/results/tuning.md#sh_step"""
CONVERTER_STEP = 16
_HEADER = struct.Struct("<IIIBBBB")
_MAGIC = 0x5053474E
_ROW = {2: 19, 3: 20}
"""Bytes of a Gaussian without SH, for each version of the format."""
_BLOCK = 1 << 20


def is_antialiased(path: str | os.PathLike[str]) -> bool:
    """Whether a file calls its model antialiased; the converter drops this flag.

    It is bit 0 of byte 14 of the header. From version 4 on, the header is plain; before, it lies inside gzip.
    """
    with open(path, "rb") as file:
        start = file.read(16)
    if start[:2] == b"\x1f\x8b":
        with gzip.open(path) as unpacked:
            start = unpacked.read(16)
    return start[:4] == b"NGSP" and len(start) == 16 and bool(start[14] & 1)


def refine_sh(coded: Path, source: SceneSource, finished: Path, chunk_rows: int = 16384) -> None:
    """Copy a `.spz` that the converter made of `source`, with SH rounded to `SH_STEP` instead.

    Raises
    ------
    InputError
        If the file has another layout: the converter then is of another version.
    """
    try:
        with (
            gzip.open(coded) as old,
            open(finished, "xb") as file,
            # No name and no time in the gzip header, so that the same scene gives the same bytes.
            gzip.GzipFile(filename="", mode="wb", compresslevel=9, fileobj=file, mtime=0) as new,
        ):
            _copy(old, new, source, chunk_rows)
    except (EOFError, struct.error, zlib.error, gzip.BadGzipFile) as error:
        raise _unknown(f"{error}") from error


def _copy(old: gzip.GzipFile, new: gzip.GzipFile, source: SceneSource, chunk_rows: int) -> None:
    head = old.read(_HEADER.size)
    magic, version, count, degree, *_ = _HEADER.unpack(head)
    if magic != _MAGIC or version not in _ROW or (count, degree) != (source.count, source.sh_degree):
        raise _unknown(f"version {version}, {count} Gaussians of SH degree {degree}")
    new.write(head)
    left = _ROW[version] * count
    while left:
        block = old.read(min(left, _BLOCK))
        if not block:
            raise _unknown(f"{left} bytes are missing before the SH")
        new.write(block)
        left -= len(block)
    width = source.width("sh_rest")
    for rows in source.chunks(chunk_rows):
        size = (rows.stop - rows.start) * width
        found = np.frombuffer(old.read(size), np.uint8)
        # [n, K, 3], from planes that are stored channel by channel.
        values = source.read(rows, ["sh_rest"])["sh_rest"].reshape(3, width // 3, -1).transpose(2, 1, 0)
        codes = sh_codes(values).reshape(-1)
        # The converter rounded the same numbers, so larger differences mean another order or other signs.
        if found.size != size or np.abs(found.astype(int) - codes).max(initial=0) > (CONVERTER_STEP + SH_STEP) // 2:
            raise _unknown("SH are not where they were expected")
        new.write(codes.astype(np.uint8).tobytes())
    if old.read(1):
        raise _unknown("bytes after the SH")


def sh_codes(values: np.ndarray) -> np.ndarray:
    """Bytes of SH coefficients, as int64; 128 stands for zero.

    >>> sh_codes(np.array([0.0, 0.07, -2.0, 5.0])).tolist()
    [128, 136, 0, 248]
    """
    top = (255 - 128) // SH_STEP
    steps = np.clip(np.rint(values.astype(np.float64) * (128 / SH_STEP)), -128 // SH_STEP, top)
    return 128 + SH_STEP * steps.astype(np.int64)


def _unknown(found: str) -> InputError:
    return InputError(
        f"the converter's .spz is not of a kind that this program knows ({found}): use gaussforge 0.6, or write "
        "another format"
    )
