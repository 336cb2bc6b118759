"""Read and write `.splat` files: 32 bytes a Gaussian, no header, no SH.

Little endian: position (3 float32), standard deviations (3 float32), red, green, blue and opacity (4 bytes), quaternion
w x y z (4 bytes, (code - 128) / 128). Colours include the constant 0.5.
"""

from pathlib import Path
from typing import BinaryIO

import numpy as np

from flexgs_edge.constants import SH_C0
from flexgs_edge.errors import FormatError
from flexgs_edge.io.codes import nearest, opacities
from flexgs_edge.io.decoded import DecodedSource, opacity_logits
from flexgs_edge.io.reading import Reading, Writing
from flexgs_edge.scene.source import Rows, SceneSource

ROW_BYTES = 32
_PARTS = {
    "means": slice(0, 12),
    "log_scales": slice(12, 24),
    "sh_dc": slice(24, 27),
    "opacity_logits": slice(27, 28),
    "quats": slice(28, 32),
}  # Bytes of each field in a row
_CHUNK_ROWS = 1 << 16


class SplatSource(DecodedSource):
    """A `.splat`: its rows, decoded when they are read.

    `name`: the user's path, for messages. `table`: [N, 32] u8, the rows of the file.
    """

    def __init__(self, name: str, table: np.ndarray) -> None:
        super().__init__(name, len(table), 0, table.nbytes)
        self._table = table

    def decode(self, rows: Rows, field: str) -> np.ndarray:
        codes = np.ascontiguousarray(self._table[rows, _PARTS[field]])
        if field == "means":
            return codes.view("<f4").T
        if field == "log_scales":
            return logs(codes.view("<f4").T)
        if field == "sh_dc":
            return (codes.T / 255.0 - 0.5) / SH_C0
        if field == "opacity_logits":
            return opacity_logits(codes.T / 255.0)
        return codes.T / 128.0 - 1


def logs(sizes: np.ndarray) -> np.ndarray:
    """f64 logarithms of sizes; that of 0 is -inf, and that of a negative one is NaN."""
    with np.errstate(divide="ignore", invalid="ignore"):
        found: np.ndarray = np.log(sizes.astype(np.float64))
    return found


def read_splat(path: Path, name: str, reading: Reading) -> SplatSource:
    """Open a `.splat`; see `Format.reader`.

    Raises `FormatError` if the size is not a multiple of 32 bytes, or there is none.
    """
    data = np.fromfile(path, np.uint8)
    if not len(data) or len(data) % ROW_BYTES:
        raise FormatError(
            f"{name}: expected a multiple of {ROW_BYTES} bytes (a Gaussian each), found {len(data)}; is it complete?"
        )
    return SplatSource(name, data.reshape(-1, ROW_BYTES))


def write_splat(file: BinaryIO, source: SceneSource, writing: Writing) -> None:
    """Write a scene of SH degree 0 as a `.splat`; see `Format.writer`."""
    for rows in source.chunks(_CHUNK_ROWS):
        planes = source.read(rows, list(_PARTS))
        table = np.empty((rows.stop - rows.start, ROW_BYTES), np.uint8)
        with np.errstate(over="ignore"):
            sizes = np.minimum(np.exp(planes["log_scales"].astype(np.float64)), np.finfo(np.float32).max)
        codes = {
            "means": _floats(planes["means"]),
            "log_scales": _floats(sizes),
            "sh_dc": nearest((planes["sh_dc"].T.astype(np.float64) * SH_C0 + 0.5) * 255),
            "opacity_logits": nearest(opacities(planes["opacity_logits"].T) * 255),
            "quats": nearest(_largest_negative(planes["quats"].astype(np.float64)).T * 128 + 128),
        }
        for field, part in _PARTS.items():
            table[:, part] = codes[field]
        file.write(table.data)


def _floats(planes: np.ndarray) -> np.ndarray:
    """[n, 12] u8."""
    with np.errstate(under="ignore"):
        return np.ascontiguousarray(planes.T, "<f4").view(np.uint8)


def _largest_negative(quats: np.ndarray) -> np.ndarray:
    """Quaternions with the sign that makes the largest component negative: the codes hold -1, but not 1."""
    largest = np.take_along_axis(quats, np.abs(quats).argmax(axis=0)[None], axis=0)
    return np.where(largest > 0, -quats, quats)
