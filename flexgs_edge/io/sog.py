"""Read SOG scenes of PlayCanvas, versions 1 and 2: a zip of pictures (`.sog`), or a folder of them with its `meta.json`.

Each pixel is a Gaussian. Pictures have the same order of rows, and pixels behind the last row are ignored.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flexgs_edge.errors import FormatError
from flexgs_edge.io.codes import unpack_small
from flexgs_edge.io.decoded import DecodedSource
from flexgs_edge.io.exact_pictures import is_lossy, picture_size, read_pixels
from flexgs_edge.io.pieces import Pieces, folder_pieces, open_zip, zip_pieces
from flexgs_edge.io.reading import Reading
from flexgs_edge.io.sog_meta import BANDS, SogMeta, parse_meta
from flexgs_edge.scene.source import Rows

META = "meta.json"
PALETTE_COLUMNS = 64  # Entries of the SH palette in a row of its picture
QUAT_MODE = 252  # Alpha of a quaternion whose largest component is w; the next ones are x, y and z
_SPARE_ROWS = 1 << 20
_ROWS_A_BYTE = 16
"""A file may hold the first number of rows, and the second for each of its bytes. Real ones need 10 to 20 bytes a row."""
_PIXEL_BYTES = 4
_SPARE_PIXELS = 1 << 16
_PIXELS_A_ROW = 4
"""Pictures may hold the first number of pixels, and the second for each row: some writers round sides up."""


def read_sog(path: Path, name: str, reading: Reading) -> SogSource:
    """Open a `.sog`; see `read_foreign`."""
    with open_zip(path, name) as archive:
        return read_pieces(zip_pieces(archive, name, META), META, name, reading)


def read_sog_folder(path: Path, name: str, reading: Reading) -> SogSource:
    """Open a `meta.json` with its pictures beside it; see `read_foreign`."""
    pieces = folder_pieces(path.parent, name)
    read: dict[str, int] = {}

    def counted(piece: str) -> bytes:
        data = pieces(piece)
        read[piece] = len(data)
        return data

    source = read_pieces(counted, path.name, name, reading)
    source.file_bytes = sum(read.values())
    return source


def read_pieces(pieces: Pieces, meta_name: str, name: str, reading: Reading) -> SogSource:
    """Open a scene whose pieces are given.

    `pieces`: gives the bytes of `meta.json` and of pictures. `meta_name`: name of the piece that names the others.
    `name`: what messages call the scene. Raises `FormatError` if a piece is missing or damaged, or does not fit the
    others.
    """
    meta = parse_meta(pieces(meta_name), f"{name}: {META}")
    data = {key: pieces(piece) for key, piece in meta.files.items()}
    size = sum(map(len, data.values()))
    if meta.count > _SPARE_ROWS + _ROWS_A_BYTE * size:
        raise FormatError(
            f"{name}: {META}: {meta.count} Gaussians cannot be in pictures of {size} bytes; is the count damaged?"
        )
    pixels = [
        _pixels_of(piece, meta.count, f"{name}: {meta.files[key]}") for key, piece in data.items() if key != "centroids"
    ]
    # All pictures stay until the last is read. Pillow holds that one twice more for a moment.
    reading.require(name, size + _PIXEL_BYTES * (sum(pixels) + 2 * max(pixels)))
    return SogSource(name, meta, data)


def _pixels_of(data: bytes, count: int, place: str) -> int:
    """Pixels of a picture that has one for each of `count` rows."""
    width, height = picture_size(data, place)
    most = _SPARE_PIXELS + _PIXELS_A_ROW * count
    if not count <= width * height <= most:
        raise FormatError(
            f"{place}: expected a picture of {count} to {most} pixels, for the {count} Gaussians of {META}, found "
            f"{width}x{height}"
        )
    return width * height


class SogSource(DecodedSource):
    """A SOG scene, with the bytes of its pictures in memory.

    `name`: what messages call it. `meta`: its checked description. `data`: the coded pictures, by the keys of
    `SogMeta.files`.
    """

    def __init__(self, name: str, meta: SogMeta, data: dict[str, bytes]) -> None:
        self._meta = meta
        count = meta.count
        places = {key: f"{name}: {piece}" for key, piece in meta.files.items()}
        rows = {key: read_pixels(data[key], places[key]).reshape(-1, 4)[:count] for key in data if key != "centroids"}
        self._means = rows["means_l"][:, :3] | rows["means_u"][:, :3].astype(np.uint16) << 8
        # Copies: a part of a picture would hold the whole picture.
        self._quats, self._sh0 = rows["quats"].copy(), rows["sh0"].copy()
        self._scales = rows["scales"][:, :3].copy()
        self._palette, self._labels = np.zeros((1, 0), np.float32), np.zeros(0, np.uint16)
        degree = 0
        if meta.sh is not None:
            degree, self._palette = _read_palette(meta, data["centroids"], places["centroids"])
            self._labels = rows["labels"][:, 0] | rows["labels"][:, 1].astype(np.int32) << 8
            beyond = self._labels >= len(self._palette) - 1
            if beyond.any():
                self._labels[beyond] = len(self._palette) - 1
                self.notes += (f"{beyond.sum()} rows name no entry of the SH palette: read without SH",)
        lossy = sorted(meta.files[key] for key in data if is_lossy(data[key]))
        if lossy:
            self.notes += (f"lossy pictures, so that values are not what was written: {', '.join(lossy)}",)
        self.settings = {"antialiased": True} if meta.antialiased else {}
        held = (self._means, self._quats, self._scales, self._sh0, self._palette, self._labels)
        super().__init__(name, count, degree, sum(array.nbytes for array in held))
        self.version = meta.version

    def decode(self, rows: Rows, field: str) -> np.ndarray:
        """See `DecodedSource.decode`."""
        if field == "means":
            lowest, highest = self._meta.bounds[:, :, None]
            share = self._means[rows].T / 65535
            logs = lowest * (1 - share) + highest * share
            return np.asarray(np.copysign(np.expm1(np.abs(logs)), logs))
        if field == "quats":
            return _unpack_quats(self._quats[rows])
        if field == "log_scales":
            return _looked_up(self._meta.scales, self._scales[rows])
        if field == "sh_dc":
            return _looked_up(self._meta.sh0[:3], self._sh0[rows, :3])
        if field == "opacity_logits":
            return _looked_up(self._meta.sh0[3:], self._sh0[rows, 3:])
        return np.asarray(self._palette[self._labels[rows]].T)


def _looked_up(tables: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """[width, n] f64, the values of codes ([n, width]) by the table of each channel."""
    return np.stack([table[column] for table, column in zip(tables, codes.T, strict=True)])


def _unpack_quats(pixels: np.ndarray) -> np.ndarray:
    """[4, n] f64, unit quaternions w x y z of pixels ([n, 4]); zeros where alpha names no component."""
    known = pixels[:, 3] >= QUAT_MODE
    mode = np.where(known, pixels[:, 3], QUAT_MODE).astype(np.int64) - QUAT_MODE
    return np.asarray((unpack_small(pixels[:, :3], mode) * known[:, None]).T)


def _read_palette(meta: SogMeta, data: bytes, place: str) -> tuple[int, np.ndarray]:
    """The SH degree, and [entries + 1, 3 K] f32, channel-major; the last row is zeros."""
    assert meta.sh is not None
    width, height = picture_size(data, place)
    degree = next((degree for degree, count in BANDS.items() if width == PALETTE_COLUMNS * count), 0)
    expected = f"{PALETTE_COLUMNS} x {', '.join(map(str, BANDS.values()))} pixels wide"
    if meta.sh_degree:
        expected = f"{PALETTE_COLUMNS * BANDS[meta.sh_degree]} pixels wide, for {meta.sh_degree} bands"
    if not degree or degree != (meta.sh_degree or degree):
        raise FormatError(f"{place}: expected a picture {expected}, found {width}x{height}")
    entries = PALETTE_COLUMNS * height if meta.palette is None else meta.palette
    if not entries <= PALETTE_COLUMNS * height <= 65536:
        raise FormatError(
            f"{place}: expected {-(-entries // PALETTE_COLUMNS)} to 1024 rows of pixels, for {entries} entries, found {height}"
        )
    codes = read_pixels(data, place)[:, :, :3].reshape(-1, BANDS[degree], 3)[:entries]
    palette = np.zeros((entries + 1, 3 * BANDS[degree]), np.float32)
    with np.errstate(over="ignore"):  # values beyond float32 become infinite, and check_scene reports them
        palette[:entries] = meta.sh.astype(np.float32)[codes.transpose(0, 2, 1).reshape(entries, -1)]
    return degree, palette
