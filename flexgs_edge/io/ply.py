"""Read and write PLY scenes in INRIA's layout, by row ranges and by chunks.

Files are read with plain reads into a small block, and not mapped. Mapped pages would count as resident memory of the
process, and a mapped file that shrinks would kill it.
"""

import io
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import numpy as np

from flexgs_edge.constants import SH_C0
from flexgs_edge.errors import FormatError, InputError
from flexgs_edge.files import atomic_write, check_readable
from flexgs_edge.io import ply_layout
from flexgs_edge.io.reading import AS_WRITTEN, Reading
from flexgs_edge.memory.rows import blocks
from flexgs_edge.scene.fields import FIELD, FIELDS
from flexgs_edge.scene.source import Planes, Rows, SceneSource

BLOCK_ROWS = 4096  # Rows read at a time: 1 MB at SH degree 3, so that gathering stays in the processor's cache
_BLOCK_BYTES = 1 << 22  # Most bytes of these rows: a file may have any number of properties
_SPAN = 4  # A list of rows is read as one span of the file if the span has at most this many rows for each wanted one
_GAP = 64
"""Rows between two wanted ones are read too, up to this many: a read of its own for the second would take as long."""
_ORIGIN_ROWS = 65536
_ORIGIN_QUANTILES = (0.05, 0.95)
_ORIGIN_FAR = 16.0
"""Scenes nearer to zero than so many extents keep origin 0: their numbers stay exact, and they can be written as
INRIA's float properties (many viewers cannot read double). At this distance, float32 has lost 4 of its 24 bits."""


class PlySource(SceneSource):
    """A PLY in INRIA's layout: any property order, byte order and float width; SH degree 0 to 4.

    Binary files are read by row ranges. plyfile loads ascii files as a whole, and also files with lists in or before
    the vertices. `choose_origin` takes the origin from a sample of the positions. We subtract it in float64, before
    positions are rounded to float32. Mip-Splatting's `filter_3D` is applied to scales and opacities. `settings` name
    the model as antialiased if it has one, or as a comment of Brush or Postshot says.

    `path`: the file; it must not change while the source is in use (checked at every read). `block_rows`: rows that are
    read at a time. `name`: the path for messages. Default: `path`. `reading`: its budget has room for a file that is
    loaded as a whole. Raises `InputError` if the file cannot be read. Raises `FormatError` if it breaks the format or is
    not a Gaussian scene; the message names the header line, the property or the bytes.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        block_rows: int = BLOCK_ROWS,
        name: str | None = None,
        reading: Reading = AS_WRITTEN,
    ) -> None:
        self.path = Path(path)
        self.name = os.fspath(path) if name is None else name
        check_readable(self.path, self.name)
        try:
            with open(self.path, "rb") as file:
                header = ply_layout.read_header(self.name, file)
                stamp = _stamp(file)
            self.sh_degree, self.notes = ply_layout.gaussian_layout(header)
            self.comments = header.comments
            self._smoothed, self._colours = ply_layout.smoothing_of(header), ply_layout.colour_names(header)
            self.doubles = any(p.type == "f8" for p in header.vertex.properties if p.name in FIELD["means"].ply)
            antialiased = self._smoothed or header.antialiased
            self.settings: dict[str, Any] = {} if antialiased is None else {"antialiased": antialiased}
            behind = header.check_size(stamp[1])
            self._rows: _RowReader
            if header.plain:
                self._rows = _FileRows(self.path, header, stamp, block_rows)
            else:
                reading.require(self.name, header.whole_bytes(stamp[1]))
                rows, behind = _load_whole(self.path, header)
                self._rows, self.held_bytes = _ArrayRows(rows, block_rows), rows.nbytes
            if behind:
                self.notes += (f"{behind} bytes behind the data ignored",)
        except OSError as error:
            raise InputError(f"{self.name}: cannot read the scene ({error.strerror})") from error
        self.count = header.vertex.count
        self.sh_count = self.count if self.sh_degree else 0
        self.origin = np.zeros(3)  # the sample is of world positions
        self.origin = choose_origin(self._sample())

    def _sample(self) -> np.ndarray:
        """[n, 3] f64: world positions of `origin_rows`."""
        rows = origin_rows(self.count)
        sample = np.empty((rows.size, 3))
        with np.errstate(invalid="ignore"):  # a signalling NaN
            for part, block in self._rows.blocks(rows):
                for axis, name in enumerate(FIELD["means"].ply):
                    sample[part, axis] = block[name]
        return sample

    def read(self, rows: Rows, fields: Sequence[str], out: Planes | None = None) -> Planes:
        """See `SceneSource.read`; needs about 1 MB beside the arrays (4 MB for lists of rows)."""
        rows, planes = self.begin_read(rows, fields, out)
        # f64 values beyond float32 become infinite here, and check_scene reports them.
        with np.errstate(over="ignore", invalid="ignore"):
            for part, block in self._rows.blocks(rows):
                for field, plane in planes.items():
                    if self._smoothed and field in ("log_scales", "opacity_logits"):
                        plane[:, part] = _smooth(block)[field]
                        continue
                    names = self._colours if field == "sh_dc" else FIELD[field].ply_names(self.sh_degree)
                    for channel, name in enumerate(names):
                        values = block[name]
                        if name in ply_layout.RGB:
                            values = (values / 255.0 - 0.5) / SH_C0
                        if field == "means":
                            values = values.astype(np.float64) - self.origin[channel]
                        plane[channel, part] = values
        return planes


def _smooth(block: np.ndarray) -> dict[str, np.ndarray]:
    """Log-scales and logits with the 3D filter applied: variances add, and opacity falls so that the Gaussian's sum stays."""
    scales = np.stack([block[name] for name in FIELD["log_scales"].ply]).astype(np.float64)
    with np.errstate(all="ignore"):  # a filter of 0 gives -inf; check_scene reports what is not finite
        wide = np.logaddexp(2 * scales, 2 * np.log(block[ply_layout.SMOOTHING].astype(np.float64))) / 2
        log_opacity = -np.logaddexp(0, -block["opacity"].astype(np.float64)) + (scales - wide).sum(axis=0)
        logits = log_opacity - np.log(-np.expm1(log_opacity))
    return {"log_scales": wide, "opacity_logits": logits[None]}


def origin_rows(count: int) -> np.ndarray:
    """[n] i64: every k-th row, at most 65536; runs of rows where these lie far apart.

    Reading single rows that lie far apart is slow: each costs the disk a move.
    """
    step = max(1, -(-count // _ORIGIN_ROWS))
    if step > _GAP:
        return (np.arange(0, count - _GAP, _GAP * step)[:, None] + np.arange(_GAP)).reshape(-1)
    return np.arange(0, count, step)


def choose_origin(positions: np.ndarray) -> np.ndarray:
    """Choose an origin for positions, so that float32 keeps their digits.

    Per axis, the 5 % and 95 % quantiles of the finite positions give a centre and an extent. The grid is the largest
    extent, rounded up to a power of two (1 if there is none). The origin is the grid point nearest to the centre. It is
    0 if the centre is within 16 grid steps of zero on every axis: such scenes lose too little to be moved.

    `positions`: [n, 3] f64, world. Returns [3] f64, world.

    >>> choose_origin(np.array([[500000.0, 0.0, 1.0], [500003.0, 1.0, 1.5]]))
    array([500000.,      0.,      0.])
    """
    finite = positions[np.isfinite(positions).all(axis=1)]
    if not len(finite):
        return np.zeros(3)
    with np.errstate(all="ignore"):
        low, high = np.quantile(finite, _ORIGIN_QUANTILES, axis=0)
        extent = float((high - low).max())
        grid = 2.0 ** np.ceil(np.log2(extent)) if extent > 0 else 1.0
        origin = np.round((low + high) / 2 / grid) * grid
        far = np.all(np.isfinite(origin)) and np.any(np.abs(origin) > _ORIGIN_FAR * grid)
    # + 0.0 turns -0.0 into 0.0, since the sign would show in files and messages.
    return origin + 0.0 if far else np.zeros(3)


class _RowReader(Protocol):
    def blocks(self, rows: Rows) -> Iterator[tuple[slice, np.ndarray]]:
        """Yield blocks of structured rows, each with its place in the result; a block is valid until the next one."""


class _ArrayRows:
    """Rows of a structured array in memory."""

    def __init__(self, array: np.ndarray, block_rows: int) -> None:
        self.array, self.block_rows = array, block_rows

    def blocks(self, rows: Rows) -> Iterator[tuple[slice, np.ndarray]]:
        if isinstance(rows, slice):
            yield slice(0, rows.stop - rows.start), self.array[rows]
            return
        for part in blocks(len(rows), self.block_rows):
            yield part, self.array[rows[part]]


class _FileRows:
    """Rows of a file, read block by block."""

    def __init__(self, path: Path, header: ply_layout.PlyHeader, stamp: tuple[int, int, int], block_rows: int) -> None:
        self.path, self.name, self.stamp = path, header.name, stamp
        self.offset = header.data_offset + sum(element.count * element.row_size for element in header.before)
        self.dtype = header.dtype(header.vertex)
        self.block_rows = max(1, min(block_rows, _BLOCK_BYTES // self.dtype.itemsize))

    def blocks(self, rows: Rows) -> Iterator[tuple[slice, np.ndarray]]:
        size = rows.stop - rows.start if isinstance(rows, slice) else len(rows)
        if not size:
            return
        try:
            with open(self.path, "rb", buffering=0) as file:
                if _stamp(file) != self.stamp:
                    raise InputError(f"{self.name}: the file was changed after it was opened; start again")
                block = np.empty(min(size, self.block_rows) * (1 if isinstance(rows, slice) else _SPAN), self.dtype)
                for part in blocks(size, self.block_rows):
                    if isinstance(rows, slice):
                        yield part, self._range(file, rows.start + part.start, block[: part.stop - part.start])
                    else:
                        yield part, self._list(file, rows[part], block)
        except OSError as error:
            raise InputError(f"{self.name}: cannot read the scene ({error.strerror})") from error

    def _list(self, file: BinaryIO, rows: np.ndarray, block: np.ndarray) -> np.ndarray:
        low, high = int(rows.min()), int(rows.max())
        if high - low < len(block):
            return _gather(self._range(file, low, block[: high - low + 1]), rows - low)
        # Rows far apart. Wanted rows close together are read with the rows between; if none lie between, straight to
        # their place.
        found, space = block[: len(rows)], block[len(rows) :]
        breaks = np.diff(rows, prepend=rows[0] - 2 * _GAP)
        starts = np.flatnonzero((breaks < 1) | (breaks > _GAP))
        for start, stop in zip(starts.tolist(), [*starts[1:].tolist(), len(rows)], strict=True):
            while start < stop:
                first = int(rows[start])
                end = start + int(np.searchsorted(rows[start:stop], first + len(space)))
                size = int(rows[end - 1]) - first + 1
                if size == end - start:
                    self._range(file, first, found[start:end])
                else:
                    found[start:end] = _gather(self._range(file, first, space[:size]), rows[start:end] - first)
                start = end
        return found

    def _range(self, file: BinaryIO, first: int, block: np.ndarray) -> np.ndarray:
        """Fill `block` with consecutive rows from `first` on."""
        view = block.view(np.uint8).data
        file.seek(self.offset + first * self.dtype.itemsize)
        done = 0
        while done < len(view):
            got = file.readinto(view[done:])  # type: ignore[attr-defined]
            if not got:
                raise FormatError(f"{self.name}: truncated while being read, at row {first}")
            done += got
        return block


def _gather(block: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """`block[rows]`, taken as rows of bytes, since NumPy copies records more slowly."""
    size = block.dtype.itemsize
    return block.view(np.uint8).reshape(-1, size).take(rows, axis=0).view(block.dtype).reshape(-1)


def _stamp(file: BinaryIO) -> tuple[int, int, int]:
    """Inode, size and time of a file, which change if it is replaced or written to."""
    status = os.fstat(file.fileno())
    return status.st_ino, status.st_size, status.st_mtime_ns


class _HeaderThenData:
    """The stream that plyfile reads: our own header (plyfile refuses UTF-8 comments), then the data, as text for ascii files.

    A plain byte stream would not do for ascii: plyfile wraps it and reads ahead, so that the bytes left could not be checked.
    """

    def __init__(self, header: ply_layout.PlyHeader, file: BinaryIO) -> None:
        self.text, self.file = not header.order, file
        self.head = io.BytesIO(header.text.encode("ascii"))
        self.left = os.fstat(file.fileno()).st_size - header.data_offset

    def read(self, size: int) -> str | bytes:
        if size < 0:
            raise ValueError(f"a list of negative length ({size})")
        # The length of a list may be false, so we ask for no more bytes than there are.
        data = self.head.read(size) or self.file.read(min(size, self.left))
        return data.decode("ascii") if self.text else data

    def readline(self) -> str:
        return self.file.readline().decode("ascii", "replace")


def _load_whole(path: Path, header: ply_layout.PlyHeader) -> tuple[np.ndarray, int]:
    """Load the rows of `vertex` by plyfile, for files that need it; they stay in memory as long as the source.

    Also returns the number of bytes behind the last element.
    """
    # plyfile is GPL-3: imported only for the files that need it.
    from plyfile import PlyData, PlyParseError

    try:
        with open(path, "rb") as file:
            file.seek(header.data_offset)
            stream = _HeaderThenData(header, file)
            whole: np.ndarray = PlyData.read(stream, mmap=False)["vertex"].data
            rest = os.fstat(file.fileno()).st_size - file.tell() if header.order else len(file.read().strip())
    except (PlyParseError, ValueError, UnicodeDecodeError, OverflowError, MemoryError) as error:
        raise FormatError(f"{header.name}: {error}") from error
    # Copies without the lists, which take many times the bytes that they have in the file.
    kinds = {name: whole.dtype[name] for name in whole.dtype.names or () if not whole.dtype[name].hasobject}
    rows = np.empty(len(whole), list(kinds.items()))
    for name in kinds:
        rows[name] = whole[name]
    return rows, rest


def write_ply(
    path: str | os.PathLike[str],
    source: SceneSource,
    *,
    force: bool = False,
    chunk_rows: int = 65536,
    double: bool = False,
) -> tuple[str, ...]:
    """Write a scene in INRIA's layout: x y z, nx ny nz (zeros), f_dc, f_rest, opacity, scale, rot; little endian.

    Properties are `float`. Positions are world positions. The source's `comments` are written to the header.

    `path`: gets its name only when the file is complete. `source`: may be the very file that is overwritten. `force`:
    replace an existing file. `chunk_rows`: rows held in memory at a time. `double`: positions are `double`; see
    `exchange.wants_double`. Returns notes for the summary. Raises `InputError` if the file exists and `force` is not
    set, or the folder is missing. Raises `BudgetError` if the disk is full.
    """
    dtype = inria_dtype(source.sh_degree, double)
    kinds = {"<f4": "float", "<f8": "double"}
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {source.count}"]
    lines += [f"property {kinds[dtype[name].str]} {name}" for name in dtype.names or ()]
    lines[2:2] = [f"comment {words}" for words in source.comments]
    with atomic_write(path, force) as file:
        file.write("\n".join([*lines, "end_header", ""]).encode("ascii"))
        table = np.zeros((min(source.count, chunk_rows), len(dtype.names or ())), np.float32)
        block = np.zeros(len(table), dtype) if double else None
        for rows in source.chunks(chunk_rows):
            part = source.read_table(rows, table)
            if block is not None:
                # All properties but the positions form one table of floats.
                whole = block[: len(part)]
                whole.view(np.uint8).reshape(len(part), -1)[:, 3 * dtype["x"].itemsize :].view("<f4")[:] = part[:, 3:]
                for axis, name in enumerate(FIELD["means"].ply):
                    whole[name] = part[:, axis] + source.origin[axis]
                file.write(whole.view(np.uint8).data)
            else:
                if np.any(source.origin != 0):
                    part[:, :3] = part[:, :3] + source.origin
                file.write(part.astype("<f4", copy=False).data)
    return ("positions written as double",) if double else ()


def inria_dtype(sh_degree: int, wide: bool = False) -> np.dtype:
    """One row of INRIA's PLY (248 bytes at degree 3); with `wide`, positions are float64.

    >>> inria_dtype(3).itemsize
    248
    """
    position, normals = FIELD["means"].ply, ("nx", "ny", "nz")
    others = [name for field in FIELDS if field.name != "means" for name in field.ply_names(sh_degree)]
    places = [(name, "<f8" if wide else "<f4") for name in position]
    return np.dtype(places + [(name, "<f4") for name in (*normals, *others)])
