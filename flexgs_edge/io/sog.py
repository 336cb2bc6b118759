"""Read SOG scenes of PlayCanvas, versions 1 and 2: a zip of pictures (`.sog`), or a folder of them with its `meta.json`.

Each pixel is a Gaussian. Pictures have the same order of rows, and pixels behind the last row are ignored.
"""

from __future__ import annotations

import os
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flexgs_edge.errors import FormatError, brief
from flexgs_edge.files import parse_json
from flexgs_edge.io.codes import unpack_small
from flexgs_edge.io.decoded import DecodedSource, opacity_logits
from flexgs_edge.io.exact_pictures import is_lossy, picture_size, read_pixels
from flexgs_edge.io.json_object import JsonObject
from flexgs_edge.io.reading import Reading
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
Pieces = Callable[[str], bytes]  # Gives the bytes of a piece by its name; raises `FormatError` if it is not there

_MOST_UNPACKED = 1 << 22
_MOST_GAIN = 8
"""A piece of a zip unpacks to at most this many bytes, and this many times its packed size. Pictures do not get smaller by
a second compression."""
_DAMAGED = (
    *(zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, struct.error, ValueError),
    *(OSError, OverflowError, IndexError, KeyError),
)  # What zipfile raises for files that it cannot read
LEVELS = 256  # Values of a byte
BANDS: dict[int, int] = {1: 3, 2: 8, 3: 15}  # SH coefficients above degree 0 of one colour channel, by SH degree
_MOST_COUNT = 2**31 - 1


def read_sog(path: Path, name: str, reading: Reading) -> SogSource:
    """Open a `.sog`; see `read_foreign`."""
    path.stat()  # the file can be read, or this error says why not
    try:
        archive = zipfile.ZipFile(path)
    except _DAMAGED as error:
        raise FormatError(f"{name}: expected a zip ({error}); is it complete?") from error
    with archive:
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

    `pieces`: gives the bytes of `meta.json` and of pictures. `meta_name`: name of the piece that names the others. `name`: what
    messages call the scene. Raises `FormatError` if a piece is missing or damaged, or does not fit the others.
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

    `name`: what messages call it. `meta`: its checked description. `data`: the coded pictures, by the keys of `SogMeta.files`.
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


def piece_place(folder: Path, piece: str, name: str) -> Path:
    """The file of a piece below a folder. Raises `FormatError` if the name leads out of the folder, also by a link."""
    inside = f"{name}: {brief(piece)}: expected the name of a file in its folder or below it"
    if not piece or "\\" in piece or ":" in piece or os.path.isabs(piece) or ".." in piece.split("/"):
        raise FormatError(inside)
    try:
        root, place = os.path.realpath(folder), os.path.realpath(folder / piece)
    except (OSError, ValueError):
        raise FormatError(f"{inside}, found one that no file can have") from None
    if os.path.commonpath([root, place]) != root:
        raise FormatError(f"{inside}, found a link that leads out of it")
    return Path(place)


def is_there(folder: Path, piece: str, name: str) -> bool:
    """Whether a piece below a folder is a file."""
    try:
        return piece_place(folder, piece, name).is_file()
    except OSError:  # such as a name that is too long
        return False


def folder_pieces(folder: Path, name: str) -> Pieces:
    """Pieces that are files in a folder or below it. `name` is what messages call the scene."""

    def read(piece: str) -> bytes:
        place = piece_place(folder, piece, name)
        if not is_there(folder, piece, name):
            raise FormatError(f"{name}: {brief(piece)}: no such file in its folder; was everything copied?")
        return place.read_bytes()

    return read


def zip_pieces(archive: zipfile.ZipFile, name: str, first: str) -> Pieces:
    """Pieces in a zip."""
    entries = {info.filename: info for info in archive.infolist()}
    homes = [entry[: -len(first)] for entry in entries if entry == first or entry.endswith(f"/{first}")]
    if not homes:
        raise FormatError(f"{name}: expected a zip with {first}, found {brief(sorted(entries))}")
    home = min(homes, key=len)

    def read(piece: str) -> bytes:
        info = entries.get(home + piece)
        if info is None:
            raise FormatError(f"{name}: {brief(piece)}: not in the zip; found {brief(sorted(entries), 200)}")
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise FormatError(
                f"{name}: {piece}: expected a stored or deflated entry, found method {info.compress_type}"
            )
        if info.file_size > _MOST_UNPACKED + _MOST_GAIN * info.compress_size:
            raise FormatError(
                f"{name}: {piece}: {info.compress_size} bytes claim to unpack to {info.file_size}: no picture does that"
            )
        try:
            with archive.open(info) as file:
                return file.read(info.file_size)
        except _DAMAGED as error:
            raise FormatError(f"{name}: {piece}: cannot be unpacked ({error}); is the file complete?") from error

    return read


@dataclass(frozen=True)
class SogMeta:
    """What `meta.json` says, with the values of bytes as tables: both versions then decode alike."""

    version: int  # 1 or 2
    count: int  # Gaussians
    antialiased: bool  # whether the model is drawn antialiased
    bounds: np.ndarray  # [2, 3] f64, lowest and highest positions in the log map
    scales: np.ndarray  # [3, 256] f64, log-scales of the bytes
    sh0: np.ndarray  # [4, 256] f64, SH coefficients of degree 0 of the bytes, and opacity logits
    sh: np.ndarray | None  # [256] f64, SH coefficients above degree 0 of the bytes; `None` if the scene has none
    sh_degree: int | None  # As the file states it. `None`: it follows from the width of the palette's picture.
    palette: int | None  # Entries of the palette. `None`: as many as its picture holds.
    # Names of the pictures: `means_l`, `means_u`, `quats`, `scales`, `sh0`, `centroids`, `labels`.
    files: dict[str, str]


def parse_meta(data: bytes, place: str) -> SogMeta:
    """Check a `meta.json`. Raises `FormatError` if a field is missing or wrong, or the version is unknown."""
    top = JsonObject(place, parse_json(data, place))
    version = top.whole("version", 1, 1, 2)
    means = top.needed("means")
    if version == 2:
        count = top.whole("count", most=_MOST_COUNT)
    else:
        shape = means.value.get("shape")
        if not isinstance(shape, list) or not shape or type(shape[0]) is not int or not 0 <= shape[0] <= _MOST_COUNT:
            raise means.fail("shape", f"a list that begins with the count, 0 to {_MOST_COUNT}")
        count = shape[0]
    antialiased = top.value.get("antialias") or False
    if not isinstance(antialiased, bool):
        raise top.fail("antialias", "true or false")
    scales, sh0 = top.needed("scales"), top.needed("sh0")
    files = dict(zip(("means_l", "means_u"), means.names("files", 2)))
    files["quats"] = top.needed("quats").names("files", 1)[0]
    files["scales"], files["sh0"] = scales.names("files", 1)[0], sh0.names("files", 1)[0]
    if version == 2:
        scale_table = np.tile(_codebook(scales), (3, 1))
        colours = np.tile(_codebook(sh0), (3, 1))
        sh0_table = np.concatenate([colours, opacity_logits(np.arange(LEVELS) / 255)[None]])
    else:
        scale_table, sh0_table = _ramps(scales, 3), _ramps(sh0, 4)
    table, degree, palette = None, None, None
    if "shN" in top:
        sh = top.needed("shN")
        degree = sh.whole("bands", most=max(BANDS)) if "bands" in sh else None
        if degree != 0:
            palette = sh.whole("count", None, 1, 65536) if "count" in sh else None
            table = _codebook(sh) if version == 2 else _steps(*(np.float64(sh.number(end)) for end in ("mins", "maxs")))
            files.update(zip(("centroids", "labels"), sh.names("files", 2)))
    return SogMeta(
        version=version,
        count=count,
        antialiased=antialiased,
        bounds=np.stack([means.numbers("mins", 3), means.numbers("maxs", 3)]),
        scales=scale_table,
        sh0=sh0_table,
        sh=table,
        sh_degree=degree if table is not None else 0,
        palette=palette,
        files=files,
    )


def _codebook(part: JsonObject) -> np.ndarray:
    """[256] f64; entries beyond the end of a shorter list are NaN, which `check_scene` reports with their rows."""
    value = part.value.get("codebook")
    if isinstance(value, list) and len(value) == LEVELS and value[0] is None and None not in value[1:]:
        # An early writer left the first entry out. PlayCanvas continues the list downwards by its mean step.
        rest = JsonObject(part.name, {"codebook": value[1:]}, part.place).numbers("codebook", LEVELS - 1)
        return np.concatenate([[rest[0] + (rest[0] - rest[-1]) / 255], rest])
    numbers = part.numbers("codebook", 1, LEVELS)
    return np.concatenate([numbers, np.full(LEVELS - len(numbers), np.nan)])


def _ramps(part: JsonObject, width: int) -> np.ndarray:
    """[width, 256] f64, equal steps between the ends of each channel."""
    return _steps(part.numbers("mins", width)[:, None], part.numbers("maxs", width)[:, None])


def _steps(lowest: np.ndarray | np.float64, highest: np.ndarray | np.float64) -> np.ndarray:
    """[..., 256] f64, equal steps between two numbers, or between those of each row."""
    shares = np.arange(LEVELS) / 255
    return np.asarray(lowest * (1 - shares) + highest * shares)
