"""The interface of scenes: metadata when opened, values by row range or row list, into arrays that the caller owns.

Sources that change what another one gives stand here too.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from flexgs_edge.constants import MAX_SH_DEGREE
from flexgs_edge.errors import InputError
from flexgs_edge.memory.rows import BLOCK_ROWS, copy_all_rows, put_rows
from flexgs_edge.memory.storage import Storage
from flexgs_edge.scene.fields import FIELD, FIELDS, sh_rest_count

Planes = dict[str, np.ndarray]  # Arrays by field name, each [width, n] f32

Rows = slice | np.ndarray  # `slice(start, stop)`, or a sorted int64 array

_TURN_ROWS = 1024
"""Rows transposed at a time: 250 kB at SH degree 3. The columns of a whole chunk would not stay in the processor's cache."""

REST_WIDTHS: dict[int, int] = {3 * sh_rest_count(degree): degree for degree in range(MAX_SH_DEGREE + 1)}
"""SH degree by the number of `sh_rest` channels: 0, 9, 24, 45, 72."""
SAMPLE_ROWS = 4096  # Most Gaussians whose positions tell which poses see which part of a scene, and how much of it
GROWTH_POWER = 0.125
"""Power by which scales grow with the number of rows that belong to a scene over those that are there:
docs/results/tuning.md#layers"""


class SceneSource(ABC):
    """N Gaussians that can be read in parts."""

    name: str  # for messages: a path or "memory"
    count: int  # N
    sh_degree: int  # 0 to 4
    sh_count: int  # Only rows [0, sh_count) may have SH above degree 0; those of other rows are zero. 0 at degree 0.
    origin: np.ndarray  # [3] f64, world: positions are relative to it
    notes: tuple[str, ...] = ()  # notes of the reader on values that it left out or changed, for the summary
    valid: bool = False  # all rows are known to pass `check_scene`, which then need not read them
    # Comments of this program in the header of a PLY, such as the step sizes of the values' grid.
    comments: tuple[str, ...] = ()
    # What the file states: how a `.fgs` was made, and how a scene is drawn (`antialiased`).
    settings: Mapping[str, Any] = MappingProxyType({})
    held_bytes: int = 0  # bytes of the file's packed values in memory, as long as the source lives
    # Bytes of all files that the scene was read from, if there are several. `None`: the size of its only file.
    file_bytes: int | None = None
    version: int | None = None  # version of the format that the file states
    doubles: bool | None = None  # positions came as float64; `None`: the file does not tell
    whole: int | None = None  # Gaussians of the scene that a cut file is a part of

    @abstractmethod
    def read(self, rows: Rows, fields: Sequence[str], out: Planes | None = None) -> Planes:
        """Read some fields of some rows.

        `rows`: `slice(start, stop)` without a step, or [n] int64, sorted ascending. `fields`: names from
        `flexgs_edge.scene.fields.FIELD`. `out`: arrays [width, n] f32 to fill; a field without one gets a new array.
        Returns {field: [width, n] f32}, with the arrays of `out` themselves if given. Raises `IndexError` if a row is
        outside [0, N). Raises `ValueError` if a field is unknown, or an array of `out` does not fit.
        """

    def read_table(self, rows: slice, out: np.ndarray) -> np.ndarray:
        """Read all fields of some rows in the layout of INRIA's PLY, row by row.

        `rows`: `slice(start, stop)` without a step. `out`: [at least n, columns] f32, with zeros in columns 3 to 5; it
        may be filled. Returns [n, columns] f32, C-contiguous, valid until the next call: means, three zeros (normals),
        the other fields in the order of `FIELDS`. It is the first rows of `out`, or an array of the source.
        """
        planes = self.read(rows, [field.name for field in FIELDS])
        part = out[: rows.stop - rows.start]
        for at in range(0, len(part), _TURN_ROWS):
            end, column = min(at + _TURN_ROWS, len(part)), 0
            for name, values in planes.items():
                part[at:end, column : column + len(values)] = values[:, at:end].T
                column += len(values) + (3 if name == "means" else 0)
        return part

    def width(self, field: str) -> int:
        """Number of channels of `field` in this scene."""
        return FIELD[field].width(self.sh_degree)

    def select(self, rows: np.ndarray) -> "SceneSource":
        """A source of the given rows ([n] int64, in any order, which is kept); nothing is read yet."""
        return SelectSource(self, rows)

    def chunks(self, rows: int) -> Iterator[slice]:
        """Yield row ranges of at most `rows` rows that cover the scene in order."""
        if rows < 1:
            raise ValueError(f"chunks of {rows} rows: expected at least 1")
        for start in range(0, self.count, rows):
            yield slice(start, min(start + rows, self.count))

    def begin_read(self, rows: Rows, fields: Sequence[str], out: Planes | None) -> tuple[Rows, Planes]:
        """Check the arguments of `read`, and allocate the arrays that `out` lacks. Readers of formats call this first.

        Returns `rows`: A slice with 0 <= start <= stop <= N, or int64. `planes`: One array [width, n] f32 a field, in
        the order of `fields`.
        """
        rows, size = normalize_rows(rows, self.count)
        if isinstance(rows, np.ndarray):
            span = as_range(rows)  # a slice is read without gathering, which is slow
            rows = rows if span is None else span
        planes: Planes = {}
        for field in fields:
            if field not in FIELD:
                raise ValueError(f"field {field!r}: expected one of {', '.join(FIELD)}")
            shape = (self.width(field), size)
            array = None if out is None else out.get(field)
            if array is None:
                array = np.empty(shape, np.float32)
            elif array.shape != shape or array.dtype != np.float32:
                raise ValueError(f"out[{field!r}]: expected {shape} float32, found {array.shape} {array.dtype}")
            planes[field] = array
        return rows, planes


def normalize_rows(rows: Rows, count: int) -> tuple[Rows, int]:
    """`rows` in plain form, and their number; raises `IndexError` for rows outside [0, count).

    >>> normalize_rows(slice(2, None), 5)
    (slice(2, 5, None), 3)
    """
    if isinstance(rows, slice):
        start, stop = rows.start or 0, count if rows.stop is None else rows.stop
        if rows.step not in (None, 1) or not 0 <= start <= stop <= count:
            raise IndexError(f"rows {rows}: expected slice(start, stop) inside [0, {count}]")
        return slice(int(start), int(stop)), int(stop) - int(start)
    rows = np.asarray(rows)
    if rows.ndim != 1 or (rows.size and rows.dtype.kind not in "iu"):
        raise IndexError(f"rows: expected [n] integers, found {list(rows.shape)} {rows.dtype}")
    if rows.size and (rows.min() < 0 or rows.max() >= count):
        raise IndexError(f"rows: {rows.min()} to {rows.max()} are not all inside [0, {count})")
    return rows.astype(np.int64, copy=False), rows.size


def as_range(rows: np.ndarray) -> slice | None:
    """`rows` as a slice if they are consecutive and ascending, else None."""
    if rows.size == 0:
        return slice(0, 0)
    if rows[-1] - rows[0] + 1 == rows.size and np.all(rows[1:] > rows[:-1]):
        return slice(int(rows[0]), int(rows[-1]) + 1)
    return None


def read_all(source: SceneSource, storage: Storage) -> Planes:
    """Read all values of a scene into arrays of `storage`: {field: [width, N] f32}."""
    planes = {field: storage.empty((source.width(field), source.count), np.float32) for field in FIELD}
    if not storage.spills:
        return source.read(slice(0, source.count), list(FIELD), planes)
    for rows in source.chunks(BLOCK_ROWS):
        for field, values in source.read(rows, list(FIELD)).items():
            put_rows(planes[field], rows, values)
    return planes


class MemorySource(SceneSource):
    """A scene whose arrays are in memory.

    `arrays`: {field: [width, N] f32}; every field of the table. `sh_rest` ([0, N]) may be missing at degree 0.
    C-contiguous float32 arrays are used as they are, never copied or changed. `sh_count`: rows from here on have no SH
    above degree 0, and zeros in their place. By default N, or 0 at degree 0. Raises `InputError` if a field is missing,
    unknown or of the wrong shape.
    """

    def __init__(
        self,
        arrays: Mapping[str, np.ndarray],
        sh_degree: int | None = None,  # by default, it follows from the width of `sh_rest`
        origin: np.ndarray | Sequence[float] | None = None,  # [3] f64, world; zeros by default
        name: str = "memory",  # for messages
        sh_count: int | None = None,
    ) -> None:
        self.name = name
        unknown = sorted(set(arrays) - set(FIELD))
        if unknown:
            raise InputError(f"{name}: unknown fields {', '.join(unknown)}; expected {', '.join(FIELD)}")
        missing = [field.name for field in FIELDS if field.name not in arrays and field.name != "sh_rest"]
        if missing:
            raise InputError(f"{name}: missing fields {', '.join(missing)}")
        self.count = int(np.shape(arrays["means"])[-1])
        planes = dict(arrays)
        planes.setdefault("sh_rest", np.zeros((0, self.count), np.float32))
        self.sh_degree = self._degree(planes["sh_rest"], sh_degree)
        self._planes = {field.name: self._plane(field.name, planes[field.name]) for field in FIELDS}
        self.sh_count = self._sh_count(sh_count)
        self.origin = np.zeros(3) if origin is None else np.array(origin, np.float64)
        if self.origin.shape != (3,) or not np.all(np.isfinite(self.origin)):
            raise InputError(f"{name}: origin: expected 3 finite numbers, found {self.origin}")

    def _degree(self, sh_rest: np.ndarray, sh_degree: int | None) -> int:
        width = np.shape(sh_rest)[0]
        if sh_degree is None:
            if width not in REST_WIDTHS:
                raise InputError(
                    f"{self.name}: sh_rest has {width} channels; expected one of {', '.join(map(str, REST_WIDTHS))}"
                )
            return REST_WIDTHS[width]
        if not 0 <= sh_degree <= MAX_SH_DEGREE:
            raise InputError(f"{self.name}: SH degree {sh_degree}: expected 0 to {MAX_SH_DEGREE}")
        return sh_degree

    def _plane(self, field: str, values: np.ndarray) -> np.ndarray:
        plane = np.ascontiguousarray(values, np.float32)
        expected = (self.width(field), self.count)
        if plane.shape != expected:
            raise InputError(f"{self.name}: {field}: expected an array {expected}, found {plane.shape}")
        return plane

    def _sh_count(self, sh_count: int | None) -> int:
        if self.sh_degree == 0:
            return 0
        if sh_count is None:
            return self.count
        if not 0 <= sh_count <= self.count:
            raise InputError(f"{self.name}: sh_count {sh_count}: expected 0 to {self.count}")
        if self._planes["sh_rest"][:, sh_count:].any():
            raise InputError(f"{self.name}: sh_rest: rows from sh_count {sh_count} on must be zeros")
        return sh_count

    def read(self, rows: Rows, fields: Sequence[str], out: Planes | None = None) -> Planes:
        rows, planes = self.begin_read(rows, fields, out)
        if isinstance(rows, slice):
            copy_all_rows([(self._planes[field], plane) for field, plane in planes.items()], rows)
        else:
            for field, plane in planes.items():
                plane[...] = self._planes[field][:, rows]
        return planes


class WrappedSource(SceneSource):
    """Another source with other values: a subclass says what it does not share with its parent, and changes the values."""

    def __init__(self, parent: SceneSource, notes: tuple[str, ...] = ()) -> None:
        self.parent, self.notes = parent, (*parent.notes, *notes)
        self.name, self.count, self.origin = parent.name, parent.count, parent.origin
        self.sh_degree, self.sh_count, self.valid = parent.sh_degree, parent.sh_count, parent.valid
        # Without comments: these values do not lie on the grid that they may name.
        self.settings, self.held_bytes = parent.settings, parent.held_bytes
        self.file_bytes, self.version, self.doubles = parent.file_bytes, parent.version, parent.doubles

    def read(self, rows: Rows, fields: Sequence[str], out: Planes | None = None) -> Planes:
        planes = self.parent.read(rows, fields, out)
        self.change(planes)
        return planes

    def change(self, planes: Planes) -> None:
        """Change values that were read from the parent; by default, none."""


class SelectSource(WrappedSource):
    """Some rows of another source, in the given order. A selection of a selection reads the first source.

    `parent`: the source of the values. `rows`: [n] integers in [0, parent.count), in any order, repeats allowed.
    `notes`: added to the parent's notes.
    """

    def __init__(self, parent: SceneSource, rows: np.ndarray, notes: tuple[str, ...] = ()) -> None:
        plain, _ = normalize_rows(np.asarray(rows), parent.count)
        assert isinstance(plain, np.ndarray)
        super().__init__(parent, notes)
        if isinstance(parent, SelectSource):
            plain, self.parent = parent.rows[plain], parent.parent
        # int32 if it suffices, for half the bytes: the list lives as long as the source.
        self.rows: np.ndarray = plain.astype(np.int32 if self.parent.count < 2**31 else np.int64)
        sh_rows = np.flatnonzero(plain < self.parent.sh_count)
        self.count, self.sh_count = plain.size, int(sh_rows[-1]) + 1 if sh_rows.size else 0

    def read(self, rows: Rows, fields: Sequence[str], out: Planes | None = None) -> Planes:
        """See `SceneSource.read`; if the rows are out of order, the values read are copied once more."""
        rows, planes = self.begin_read(rows, fields, out)
        chosen = self.rows[rows].astype(np.int64)
        consecutive = as_range(chosen)
        if consecutive is not None:
            self.parent.read(consecutive, fields, planes)
        elif np.all(chosen[1:] >= chosen[:-1]):
            self.parent.read(chosen, fields, planes)
        else:
            order = np.argsort(chosen, kind="stable")
            for field, plane in planes.items():  # one field at a time, so that the copy holds only one
                plane[:, order] = self.parent.read(chosen[order], [field])[field]
        return planes


def by_chunk(rows: Rows, starts: np.ndarray) -> Iterator[tuple[int, Rows, slice]]:
    """Cut a slice or a sorted list of rows at the chunks.

    `rows`: as `SceneSource.begin_read` gives them. `starts`: [c] i64, the first row of every chunk. Yields the number
    of the chunk, the rows in it, and their place in the output.
    """
    if isinstance(rows, slice):
        at = rows.start
        while at < rows.stop:
            chunk = int(np.searchsorted(starts, at, side="right")) - 1
            stop = min(rows.stop, int(starts[chunk + 1])) if chunk + 1 < len(starts) else rows.stop
            yield chunk, slice(at, stop), slice(at - rows.start, stop - rows.start)
            at = stop
        return
    # Cut where the chunk changes: a list that is not sorted then only costs more reads.
    if len(rows) == 0:
        return
    chunks = np.searchsorted(starts, rows, side="right") - 1
    cuts = np.flatnonzero(np.diff(chunks, prepend=-1))
    for start, stop in zip(cuts.tolist(), [*cuts[1:].tolist(), len(rows)], strict=True):
        yield int(chunks[start]), rows[start:stop], slice(start, stop)


def some_positions(source: SceneSource, most: int = SAMPLE_ROWS) -> np.ndarray:
    """[3, n] f64, world coordinates of at most `most` rows, evenly spread over the scene's rows."""
    rows = np.arange(0, source.count, max(-(-source.count // most), 1))
    return source.read(rows, ["means"])["means"].astype(np.float64) + source.origin[:, None]


def growth(there: int, whole: int) -> np.float32:
    """What the log-scales of `there` rows (above 0) grow by when they stand for a scene of `whole` rows."""
    return np.float32(GROWTH_POWER * math.log(whole / there))


class GrownSource(WrappedSource):
    """A part of a scene of `whole` rows, grown to stand for all of it."""

    def __init__(self, parent: SceneSource, whole: int) -> None:
        super().__init__(parent)
        self._growth = growth(max(parent.count, 1), whole)

    def change(self, planes: Planes) -> None:
        if "log_scales" in planes:
            planes["log_scales"] += self._growth


class TrimmedSource(WrappedSource):
    """A scene with SH up to a lower degree, and without SH where `keeps_sh` ([N] bool) is false."""

    def __init__(self, parent: SceneSource, keeps_sh: np.ndarray, degree: int, notes: tuple[str, ...] = ()) -> None:
        super().__init__(parent, notes)
        self.keeps_sh, self.sh_degree = keeps_sh, min(degree, parent.sh_degree)
        self.sh_count = parent.sh_count if self.sh_degree else 0

    def read(self, rows: Rows, fields: Sequence[str], out: Planes | None = None) -> Planes:
        rows, planes = self.begin_read(rows, fields, out)
        self.parent.read(rows, [name for name in fields if name != "sh_rest"], planes)
        if "sh_rest" in planes and self.sh_degree:
            whole = self.parent.read(rows, ["sh_rest"])["sh_rest"] * self.keeps_sh[rows]
            planes["sh_rest"][...] = lower_degree(whole, self.sh_degree)
        return planes


def without_degrees(source: SceneSource, most: int | None) -> SceneSource:
    """`source` with SH up to degree `most`, and a note on what is left out; `source` itself if nothing is."""
    if most is None or source.sh_degree <= most:
        return source
    note = f"SH above degree {most} left out (the file has degree {source.sh_degree})"
    # Nobody asks which rows keep their SH if none does.
    return TrimmedSource(source, np.ones(source.count if most else 0, bool), most, (note,))


def lower_degree(sh_rest: np.ndarray, degree: int) -> np.ndarray:
    """[3 K', n] SH up to `degree` from [3 K, n] SH. Both lie channel by channel.

    >>> lower_degree(np.arange(24.0).reshape(24, 1), 1).ravel().tolist()
    [0.0, 1.0, 2.0, 8.0, 9.0, 10.0, 16.0, 17.0, 18.0]
    """
    width, count = sh_rest.shape
    channels = sh_rest.reshape(3, width // 3, count)[:, : sh_rest_count(degree)]
    return np.ascontiguousarray(channels.reshape(3 * channels.shape[1], count))
