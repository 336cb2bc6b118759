"""Gradient descent on a scene that memory cannot hold: its state lies in scratch files, and a step moves what a view shows.

The values are those of `Descent`, bit for bit: a step changes no row that its view does not show.
"""

from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.kernels.backend import Backend
from flexgs_edge.memory.rows import copy_rows, put_rows, read_rows
from flexgs_edge.memory.storage import Storage
from flexgs_edge.methods.best.refit import descent
from flexgs_edge.render.chunks import ChunkArrays, ChunkBounds
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.fit import GRADIENT_SUMS, RAW_BYTES, Fit, padded, plane_bytes, sum_bytes
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.source import MemorySource, SceneSource

CHUNK_ROWS = 1 << 14
"""Most rows of a chunk: 4 MB of values at SH degree 3. Larger ones would hold more rows that a view does not show."""
RECORD = 16  # Values of a splat's record


@dataclass
class Part:
    """Where a chunk's state lies in the files, and what is still to be done to it.

    `at`, `powers_at`: first element in the files of planes, and in that of powers.
    """

    base: int
    count: int
    degree: int
    at: int
    powers_at: int
    # Whether a step has moved the chunk. Before, its running means of gradients are zero and not in the files.
    stepped: bool = False
    mean: str = "none"  # whether there is a mean of the values, and whether it is in its file or equal to the values
    # Shares by which the mean is still to follow the values as they are.
    pending: list[float] = field(default_factory=list)

    @property
    def stride(self) -> int:
        """Rows in the files."""
        return padded(self.count)

    @property
    def span(self) -> slice:
        """Elements in the files of planes."""
        return slice(self.at, self.at + sum(descent.widths(self.degree).values()) * self.stride)

    @property
    def powers_span(self) -> slice:
        """Elements in the file of powers."""
        return slice(self.powers_at, self.powers_at + 2 * self.stride)


class MovingPlanes:
    """Fills the chunks that views are drawn from (`ChunkPlanes`): values put on their grids."""

    def __init__(self, backend: Backend, source: SceneSource) -> None:
        self.backend, self.origin = backend, source.origin
        self.count, self.sh_count, self.sh_degree = source.count, source.sh_count, source.sh_degree
        self.bounds: dict[int, ChunkBounds] = {}
        self.parts: dict[int, Part] = {}
        self.values = np.zeros(0, np.float32)
        self.steps = backend.array((descent.GRID_VALUES,), np.float32)
        self._room: Any = None
        self._drawn: Callable[[], None] = lambda: None

    def load(self, start: int, stop: int, planes: dict[str, Any]) -> None:
        """Put rows [start, stop) on the grid, into arrays of the backend."""
        part, stride = self.parts[start], padded(stop - start)
        shape = (sum(descent.widths(part.degree).values()), stride)
        self._drawn()
        if self._room is None or self._room.shape != shape:
            self.close_room()
            self._room = self.backend.array(shape, np.float32)
        with self.backend.mapped(self._room) as host:
            copy_rows(self.values, part.span, host.reshape(-1))
        stored = [planes[name] for name in descent.ORDER]
        self.backend.launch("snap", (stride,), stride, part.degree, self.steps, self._room, *stored)
        self._drawn = self.backend.mark()
        if start not in self.bounds:
            self.bounds[start] = bounds_of(self.backend, stored[0], stored[1], stop - start)

    def close_room(self) -> None:
        """Free the room for the values of a chunk."""
        if self._room is not None:
            self._room.release()
            self._room = None

    def close(self) -> None:
        """Free everything."""
        self.close_room()
        self.steps.release()


def bounds_of(backend: Backend, means: Any, log_scales: Any, count: int) -> ChunkBounds:
    """Bounds of the first `count` rows of planes on the backend."""
    return ChunkBounds.of(backend.read(means)[:, :count], backend.read(log_scales)[:, :count])


def parts_of(spans: Iterable[tuple[int, int, int]]) -> list[Part]:
    """Lay chunks (first row, row after the last, SH degree) out in the files, one after the other."""
    parts: list[Part] = []
    at = powers_at = 0
    for start, stop, degree in spans:
        parts.append(Part(start, stop - start, degree, at, powers_at))
        at, powers_at = parts[-1].span.stop, parts[-1].powers_span.stop
    return parts


def open_descent(
    renderer: Renderer,
    planes: dict[str, np.ndarray],
    degrees: np.ndarray,
    origin: np.ndarray,
    camera: Camera,
    structure: float = 0.0,
) -> "descent.Descent | StreamedDescent":
    """A descent in memory, or in scratch files if the renderer's storage has them and memory has no room.

    Parameters are those of `Descent`.
    """
    if renderer.storage.spills:
        source = MemorySource(planes, origin=origin)
        with renderer.load(
            source, descent.descent_bytes(source.sh_degree), references=True, structure=structure > 0
        ) as scene:
            if not renderer.fits(scene, camera):
                return StreamedDescent(renderer, planes, degrees, origin, structure)
    return descent.Descent(renderer, planes, degrees, origin, camera, structure)


def streamed_rows(fit: Fit, count: int) -> int:
    """Rows of a chunk of a scene of `count` rows."""
    return min(CHUNK_ROWS, fit.compact_rows, max(count, 1))


def streamed_descent_bytes(sh_degree: int, rows: int) -> int:
    """Bytes that a step takes for a chunk of so many rows, beside the view.

    They hold the chunk's state, two copies of its planes on their way from and to the files, the values that are drawn, records
    and sums twice, and the values of a chunk that is loaded to be drawn.
    """
    planes = 4 * sum(descent.widths(sh_degree).values())
    own = (descent.PLANE_SETS + 3) * planes + plane_bytes(sh_degree) + RAW_BYTES + 4 * 4
    return padded(rows) * (own + 2 * (4 * RECORD + sum_bytes(GRADIENT_SUMS)))


class StreamedDescent(AbstractContextManager["StreamedDescent"]):
    """As `Descent`, with all state in scratch files.

    A step draws its view chunk by chunk, and then moves the chunks of which it shows something. A mean follows the values of the
    other chunks later, when a view shows them: they do not change until then.

    `planes`, `degrees`, `origin`, `structure`: as for `Descent`.
    """

    def __init__(
        self,
        renderer: Renderer,  # With nothing loaded. Its storage holds the state.
        planes: dict[str, np.ndarray],
        degrees: np.ndarray,
        origin: np.ndarray,
        structure: float = 0.0,
    ) -> None:
        self.renderer, self.backend, self.structure = renderer, renderer.backend, structure
        self.storage: Storage = renderer.storage
        source = MemorySource(planes, origin=origin, sh_count=int(np.flatnonzero(degrees).max(initial=-1)) + 1)
        self.count, self.widths, fit = source.count, descent.widths(source.sh_degree), renderer.fit
        self._degrees, self._priced = degrees, False
        self._planes = MovingPlanes(self.backend, source)
        self._scene = DeviceScene(
            self.backend,
            self._planes,
            renderer.budget,
            renderer.antialiased,
            sum_bytes(GRADIENT_SUMS),
            references=True,
            structure=structure > 0,
            view_sums=GRADIENT_SUMS,
            fit=replace(fit, compact_rows=streamed_rows(fit, self.count), spare_share=1),
        )
        self._state: descent.ChunkState | None = None
        self._chunk: ChunkArrays | None = None
        self._splats: tuple[Any, Any] | None = None
        self._arrays: list[Any] = []
        try:
            renderer.release()
            self._scene.be_compact(fit.capacity(self.count, 1 / fit.first_share))
            self._rates, self._prices = (self._array(n) for n in (sum(self.widths.values()), descent.PRICE_VALUES))
            self._parts = parts_of(self._scene.spans())
            self._planes.parts = {part.base: part for part in self._parts}
            size, powers = (self._parts[-1].span.stop, self._parts[-1].powers_span.stop) if self._parts else (0, 0)
            self._first, self._second, self._mean = (self.storage.empty((size,), np.float32) for _ in range(3))
            self._planes.values, self._powers = (self.storage.empty((n,), np.float32) for n in (size, powers))
            for part in self._parts:
                self._fill(part, planes)
            self.put_on(None)
        except BaseException:
            self.close()
            raise

    def _array(self, count: int) -> Any:
        self._arrays.append(self.backend.array((count,), np.float32))
        return self._arrays[-1]

    def _fill(self, part: Part, planes: dict[str, np.ndarray]) -> None:
        own = descent.widths(part.degree)
        values = np.zeros((sum(own.values()), part.stride), np.float32)
        for _, rows, some in descent.fields_of(planes, own):
            read = read_rows(some, slice(part.base, part.base + part.count))
            values[rows, : part.count] = read.reshape(-1, part.count)
        put_rows(self._planes.values, part.span, values.reshape(-1))

    def put_on(self, steps: StepSizes | None) -> None:
        """As `Descent.put_on`."""
        self.backend.write(self._planes.steps, descent.step_record(steps))
        self._planes.bounds.clear()

    def price(self, prices: np.ndarray) -> None:
        """As `Descent.price`."""
        self.backend.write(self._prices, prices)
        self._priced = True

    def step(self, camera: Camera, target: np.ndarray, rates: dict[str, float], share: float = 0.0) -> None:
        """As `Descent.step`."""
        sums = self.renderer.gradient_sums(self._scene, camera, target, self.structure)
        records, shown = self.renderer.records_array, self.renderer.view_rows
        assert shown is not None
        self.backend.write(self._rates, descent.rate_record(rates, self.widths))
        ends = np.searchsorted(shown, [part.base + part.count for part in self._parts])
        for part, first, last in zip(self._parts, [0, *ends[:-1]], ends, strict=True):
            if first == last:
                continue
            some = self.backend.read(
                sums, np.empty((last - first, GRADIENT_SUMS, 2), np.uint32), first * 2 * GRADIENT_SUMS
            )
            if not some.any():
                continue
            own = self.backend.read(records, np.empty((last - first, RECORD), np.float32), first * RECORD)
            self._move(part, shown[first:last] - np.uint32(part.base), own, some)
        if share > 0:
            self._follow(share)

    def _move(self, part: Part, rows: np.ndarray, records: np.ndarray, sums: np.ndarray) -> None:
        """Take one step of Adam for the rows of a chunk that a view shows."""
        state = self._opened(part)
        self._follow_up(part, state)
        place_records, place_sums = self._splats_of(part)
        wide_records, wide_sums = (np.zeros(array.shape, array.dtype) for array in (place_records, place_sums))
        wide_records[rows], wide_sums[rows] = records, sums
        self.backend.write(place_records, wide_records)
        self.backend.write(place_sums, wide_sums)
        state.snap(self._planes.steps)
        state.differentiate(self.renderer.camera_array, place_records, place_sums, 0)
        state.step(self._rates, self._planes.steps, self._prices if self._priced else None)
        part.stepped = True
        self._planes.bounds[part.base] = bounds_of(self.backend, state.chunk.means, state.stored[0], part.count)
        for file, array in (
            (self._planes.values, state.values),
            (self._first, state.first),
            (self._second, state.second),
        ):
            self._save(file, part.span, array)
        self._save(self._powers, part.powers_span, state.powers)
        if part.mean == "own":
            self._save(self._mean, part.span, state.mean)

    def _opened(self, part: Part) -> descent.ChunkState:
        """The state of a chunk on the backend, without its mean."""
        state = self._room_for(part)
        self._load(state.values, self._planes.values, part.span)
        if part.stepped:
            self._load(state.first, self._first, part.span)
            self._load(state.second, self._second, part.span)
            self._load(state.powers, self._powers, part.powers_span)
        else:
            state.begin()
        state.put_degrees(self._degrees[part.base : part.base + part.count])
        return state

    def _follow_up(self, part: Part, state: descent.ChunkState) -> None:
        """Bring the mean up to the values as they are, and make it the chunk's own, if there is one."""
        if part.mean == "own":
            self._load(state.mean, self._mean, part.span)
        elif part.mean == "values":
            state.follow(1.0)
            part.mean = "own"
        for share in part.pending:
            state.follow(share)
        part.pending = []

    def _room_for(self, part: Part) -> descent.ChunkState:
        if self._state is None or (self._state.chunk.degree, self._state.chunk.stride) != (part.degree, part.stride):
            self._free_room()
            self._chunk = ChunkArrays(self.backend, part.degree, part.stride)
            self._state = descent.ChunkState(self.backend, self._chunk.chunk(0, part.count), self.renderer.antialiased)
        self._state.chunk.count = part.count
        return self._state

    def _splats_of(self, part: Part) -> tuple[Any, Any]:
        """Records and sums of a chunk's rows, on the backend."""
        if self._splats is None:
            shapes = ((part.stride, RECORD), np.float32), ((part.stride, GRADIENT_SUMS, 2), np.uint32)
            records, sums = (self.backend.array(*shape) for shape in shapes)
            self._splats = records, sums
        return self._splats

    def _free_room(self) -> None:
        for held in (self._state, self._chunk, *(self._splats or ())):
            if held is not None:
                held.release()
        self._state = self._chunk = self._splats = None

    def _load(self, array: Any, file: np.ndarray, span: slice) -> None:
        self.backend.write(array, read_rows(file, span))

    def _save(self, file: np.ndarray, span: slice, array: Any) -> None:
        put_rows(file, span, self.backend.read(array).reshape(-1))

    def _follow(self, share: float) -> None:
        """Note that the mean follows, for when the chunk is read next."""
        for part in self._parts:
            if share >= 1.0:
                part.mean, part.pending = "values", []
            elif part.mean == "own":
                part.pending.append(share)

    def settle(self) -> None:
        """As `Descent.settle`."""
        for part in self._parts:
            if part.mean == "own":
                state = self._room_for(part)
                self._load(state.values, self._planes.values, part.span)
                self._follow_up(part, state)
                self._save(self._planes.values, part.span, state.mean)
                part.mean = "values"
        self._planes.bounds.clear()

    def planes(self) -> dict[str, np.ndarray]:
        """As `Descent.planes`, in the renderer's storage."""
        whole = {name: self.storage.empty((width, self.count), np.float32) for name, width in self.widths.items()}
        for part in self._parts:
            span = slice(part.base, part.base + part.count)
            values = read_rows(self._planes.values, part.span).reshape(-1, part.stride)[:, : part.count]
            own = descent.widths(part.degree)
            for name, rows, out in descent.fields_of(whole, own):
                put_rows(out, span, values[rows].reshape(*out.shape[:-1], part.count))
                if own[name] < self.widths[name]:
                    rest = whole[name].reshape(3, -1, self.count)[:, own[name] // 3 :]
                    put_rows(rest, span, np.zeros(1, np.float32))
        return whole

    def close(self) -> None:
        """Free everything."""
        self._free_room()
        for array in self._arrays:
            array.release()
        self._arrays, self._parts = [], []
        self._scene.close()

    def __exit__(self, *exc: object) -> None:
        self.close()
