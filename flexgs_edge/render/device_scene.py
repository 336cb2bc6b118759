"""A scene in the backend's memory, by chunks: kept there when it fits, streamed view by view when it does not."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import numpy as np

from flexgs_edge.budget import MemoryBudget
from flexgs_edge.constants import DEQUANTIZE_ROWS, LANES
from flexgs_edge.kernels import Backend
from flexgs_edge.quantize import QuantizedArray, QuantizedScene
from flexgs_edge.render.chunk_bounds import ChunkBounds
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import SceneSource

CHUNK_ROWS = 1 << 18
"""Most rows of a chunk: 60 MB of planes at SH degree 3, large enough that launches cost nothing."""
MIN_CHUNK_ROWS = 1 << 10
COMPACT_ROWS = 1 << 15
"""Rows of a chunk of a scene whose views are compact: 16 MB with all that projecting it takes."""


def sum_bytes(planes: int) -> int:
    """Bytes a row of a scoring pass's hits and of so many planes of 64-bit sums."""
    return 4 + 8 * planes


SUM_BYTES = sum_bytes(1)
MOST_SUMS = 6
"""Planes of sums that a view has at most (`Renderer.residual_and_removal_sums`)."""


def plane_bytes(sh_degree: int) -> int:
    """Bytes a row of an activated chunk: means, covariance (or its factor), log2 of the opacity, colour."""
    return 4 * (3 + 6 + 1 + 3 + FIELD["sh_rest"].width(sh_degree))


RAW_BYTES = 4 * (3 + 4 + 1)
"""Bytes a row that loading needs on top for a moment: stored scale, rotation, opacity."""


def streamed_bytes(sh_degree: int) -> int:
    """Bytes a row of a streamed chunk, and of the one that is loaded while it is drawn."""
    return 2 * (plane_bytes(sh_degree) + RAW_BYTES)


@dataclass
class Chunk:
    """Planes of rows [base, base + count) of a scene, ready for `project`."""

    base: int
    count: int
    stride: int
    degree: int
    means: Any
    cov: Any
    log2_opacity: Any
    sh_dc: Any
    sh_rest: Any

    @property
    def arrays(self) -> tuple[Any, ...]:
        """All planes."""
        return self.means, self.cov, self.log2_opacity, self.sh_dc, self.sh_rest

    def release(self) -> None:
        """Free the planes."""
        for array in self.arrays:
            array.release()


def padded(count: int) -> int:
    """Elements of a plane that holds `count` rows."""
    return -(-count // LANES) * LANES


def _nothing() -> None:
    """Waits for no kernel."""


class _ChunkArrays:
    """What a chunk lies in on the backend: stored planes, and what they are activated to."""

    def __init__(self, backend: Backend, degree: int, stride: int) -> None:
        self.backend, self.degree, self.stride = backend, degree, stride
        shapes = {name: (field.width(degree), stride) for name, field in FIELD.items()}
        self.stored = {name: backend.array(shape, np.float32) for name, shape in shapes.items()}
        self.cov = backend.array((6, stride), np.float32)
        self.log2_opacity = backend.array((stride,), np.float32)

    def activated(self, base: int, count: int, antialiased: bool) -> Chunk:
        """The chunk of the rows that are stored."""
        stored, stride = self.stored, self.stride
        self.backend.launch(
            "activate", (stride,), stride, int(antialiased), stored["log_scales"], stored["quats"],
            stored["opacity_logits"], self.cov, self.log2_opacity,
        )  # fmt: skip
        colours = stored["sh_dc"], stored["sh_rest"]
        return Chunk(base, count, stride, self.degree, stored["means"], self.cov, self.log2_opacity, *colours)

    def release_raw(self) -> None:
        """Free what is not needed once it is activated."""
        for name in ("log_scales", "quats", "opacity_logits"):
            self.stored[name].release()

    def release(self) -> None:
        """Free everything."""
        for array in (*self.stored.values(), self.cov, self.log2_opacity):
            array.release()


class SourcePlanes:
    """Fills chunks from a `SceneSource`, whose means and scales stay as they are; colours may change."""

    def __init__(self, backend: Backend, source: SceneSource) -> None:
        self.backend = backend
        self.source = source
        self.count, self.sh_count, self.sh_degree = source.count, source.sh_count, source.sh_degree
        self.origin = source.origin
        self.bounds: dict[int, ChunkBounds] = {}
        """Of the chunks loaded so far, by their first rows."""

    def load(self, start: int, stop: int, planes: dict[str, Any]) -> None:
        """Fill arrays of the backend, [width, padded(stop - start)] by field name."""
        with ExitStack() as maps:
            host = {
                name: maps.enter_context(self.backend.mapped(array))[:, : stop - start]
                for name, array in planes.items()
                if array.shape[0]
            }
            self.source.read(slice(start, stop), list(host), host)
            if start not in self.bounds:
                self.bounds[start] = ChunkBounds.of(host["means"], host["log_scales"])

    def close(self) -> None:
        """Nothing is held."""


class QuantizedPlanes:
    """Fills chunks from a quantized scene: codes and ranges are copied to the backend once and dequantized there."""

    def __init__(self, backend: Backend, quantized: QuantizedScene) -> None:
        self.backend = backend
        self.count, self.sh_count, self.sh_degree = quantized.count, quantized.sh_count, quantized.sh_degree
        self.origin = quantized.origin
        self.bounds: dict[int, ChunkBounds] = {}  # every view reads all chunks
        self._arrays: dict[str, tuple[QuantizedArray, Any, Any, Any]] = {}
        for name, array in quantized.arrays.items():
            # Three spare bytes: the kernel reads a code through a window of three.
            codes = backend.array((array.planes.size + 3,), np.uint8)
            backend.write(codes, array.planes.reshape(-1))
            low = backend.array(array.low.shape, np.float32)
            step = backend.array(array.step.shape, np.float32)
            backend.write(low, array.low)
            backend.write(step, array.step)
            self._arrays[name] = (array, codes, low, step)

    def load(self, start: int, stop: int, planes: dict[str, Any]) -> None:
        """Fill arrays of the backend, [width, padded(stop - start)] by field name."""
        rows = stop - start
        for name, plane in planes.items():
            width, stride = plane.shape
            if width == 0:
                continue
            array, codes, low, step = self._arrays[name]
            size = (-(-rows // DEQUANTIZE_ROWS), width)
            self.backend.launch(
                "dequantize", size, array.count, array.groups, array.bits, array.planes.shape[1], start, rows, stride,
                codes, low, step, plane,
            )  # fmt: skip

    def close(self) -> None:
        """Free codes and ranges."""
        for _, *arrays in self._arrays.values():
            for array in arrays:
                array.release()
        self._arrays = {}


class DeviceScene:
    """A scene on a backend. Iterate over `chunks()` for every view; close when done.

    Whether it stays in the backend's memory or is streamed view by view is decided when the first view asks for it, from what
    that view leaves free; the result is the same.

    Parameters
    ----------
    backend : Backend
    planes : SourcePlanes or QuantizedPlanes
        Asked for each chunk once when the scene fits into the budget, once a view when it does not.
    budget : MemoryBudget
    antialiased : bool
        How it is drawn: `cov` of the chunks is then the covariance's factor.
    sum_bytes : int
        Bytes a row that sums over its views will take on the backend: left free.
    targets : bool
        Views will be compared with targets on the backend: room for these is taken with the view's.
    """

    def __init__(
        self,
        backend: Backend,
        planes: SourcePlanes | QuantizedPlanes,
        budget: MemoryBudget,
        antialiased: bool = False,
        sum_bytes: int = SUM_BYTES,
        targets: bool = False,
    ) -> None:
        self.backend = backend
        self.count = planes.count
        self.sh_degree = planes.sh_degree if planes.sh_count else 0
        self.origin = planes.origin
        self.antialiased = antialiased
        self.statistics: list[Any] = []
        self.resident, self._streamed = False, False
        self.targets = targets
        self.sum_bytes = sum_bytes
        self.shown: int | None = None
        """Rows that a compact view has room for; None while views have room for all."""
        self._planes = planes
        self._budget = budget
        self._resident: list[Chunk] = []
        self._rows = 0
        self._chunk_row_bytes = streamed_bytes(planes.sh_degree)
        self._least_rows = min(MIN_CHUNK_ROWS, max(self.count, 1))

    @property
    def source(self) -> SceneSource | None:
        """Where its values come from; None where that is codes on the backend."""
        return self._planes.source if isinstance(self._planes, SourcePlanes) else None

    @property
    def least_bytes(self) -> int:
        """Bytes that drawing must leave to the scene: none once it is loaded, else its smallest chunk."""
        return 0 if self._resident else self.least_chunk_bytes

    @property
    def least_chunk_bytes(self) -> int:
        """Bytes of the smallest chunk."""
        return padded(self._least_rows) * self._chunk_row_bytes

    @property
    def whole_bytes(self) -> int:
        """Bytes of all chunks, loaded."""
        planes = self._planes
        whole = planes.sh_count * plane_bytes(planes.sh_degree) + (self.count - planes.sh_count) * plane_bytes(0)
        # Two chunks may be padded at most: the last with SH and the last without.
        return whole + 2 * LANES * self._chunk_row_bytes

    @property
    def later_bytes(self) -> int:
        """Bytes that sums over views will take: none once the first view made them."""
        return 0 if self.statistics else self.sum_bytes * self.count

    @property
    def shown_bytes(self) -> int:
        """Bytes that each row which a compact view shows takes of the sums of one view: all but what is added up over views."""
        return 0 if self.statistics else min(self.sum_bytes, sum_bytes(MOST_SUMS))

    @property
    def held_bytes(self) -> int:
        """Bytes that the loaded scene takes."""
        return sum(array.nbytes for chunk in self._resident for array in chunk.arrays)

    def fingerprint(self) -> bytes | None:
        """Digest of all that views are drawn from; None while that is not on the backend."""
        if not self.resident:
            return None
        digest = hashlib.sha256(repr((self.count, self.origin.tolist(), self.antialiased)).encode())
        for chunk in self._resident:
            digest.update(repr((chunk.base, chunk.count, chunk.degree)).encode())
            for array in chunk.arrays:
                digest.update(self.backend.read(array)[..., : chunk.count].tobytes())
        return digest.digest()

    def be_compact(self, shown: int) -> None:
        """From now on views have room for the rows that they show alone, for so many at first; the scene is streamed."""
        self.evict()
        self.shown = shown

    def drop_statistics(self) -> None:
        """Free the sums of a view."""
        for array in self.statistics:
            array.release()
        self.statistics = []

    def _decide(self) -> None:
        """Load the scene if it fits, else find the rows of a streamed chunk (fixed from then on)."""
        budget, later = self._budget, self.later_bytes
        if self.shown is not None:
            self._rows = min(COMPACT_ROWS, max(self.count, 1))
            self._streamed = True
            return
        most = min(CHUNK_ROWS, max(self.count, 1))
        whole = self.whole_bytes + later
        fits = budget.free >= whole + padded(self._rows or self._least_rows) * RAW_BYTES
        if not self._rows:
            spare = budget.free - whole if fits else budget.free - later
            per_row = RAW_BYTES if fits else self._chunk_row_bytes
            # Whole vectors: chunks and the sums over them are padded at the ends of the scene's two parts alone.
            self._rows = max(min(most, (spare // per_row // LANES - 2) * LANES), self._least_rows)
        if fits:
            self._resident = [self._load(*span) for span in self._spans()]
        # Not asked again in the middle of a view, when part of what it left free is taken.
        self.resident, self._streamed = fits, not fits

    def evict(self) -> None:
        """Give the memory of a loaded scene back; the next view decides again."""
        for chunk in self._resident:
            chunk.release()
        self._resident, self.resident, self._streamed = [], False, False

    def _spans(self) -> Iterator[tuple[int, int, int]]:
        """(start, stop, degree): rows with SH first, then the block without."""
        planes = self._planes
        parts = ((0, planes.sh_count, planes.sh_degree), (planes.sh_count, planes.count, 0))
        for first, last, degree in parts:
            for start in range(first, last, self._rows):
                yield start, min(start + self._rows, last), degree

    @property
    def starts(self) -> np.ndarray:
        """[chunks + 1] i64: first row of every chunk, and the number of rows."""
        if not self._rows:
            self._decide()
        return np.array([*(start for start, _, _ in self._spans()), self.count], np.int64)

    def _load(self, start: int, stop: int, degree: int) -> Chunk:
        """A chunk that stays."""
        arrays = _ChunkArrays(self.backend, degree, padded(stop - start))
        self._planes.load(start, stop, arrays.stored)
        chunk = arrays.activated(start, stop - start, self.antialiased)
        arrays.release_raw()
        return chunk

    def chunks(self, wanted: Callable[[ChunkBounds], bool] | None = None) -> Iterator[Chunk]:
        """The scene's chunks in row order; a streamed chunk lives until the next one is asked for, and is loaded before.

        Streamed chunks that were loaded before and whose bounds are not `wanted` are left out, and not read.
        """
        if not self.resident and not self._streamed:
            self._decide()
        if self.resident:
            yield from self._resident
            return
        bounds = self._planes.bounds
        spans = [span for span in self._spans() if wanted is None or span[0] not in bounds or wanted(bounds[span[0]])]
        slots: list[_ChunkArrays] = []
        # Kernels that use the chunk before the one that is asked for.
        done: Callable[[], None] = _nothing
        loader = ThreadPoolExecutor(1)
        try:
            loaded = self._load_into(slots, loader, done, *spans[0]) if spans else None
            for place, (start, stop, _) in enumerate(spans):
                assert loaded is not None
                arrays = loaded.result()
                if place + 1 < len(spans):
                    loaded = self._load_into(slots, loader, done, *spans[place + 1])
                yield arrays.activated(start, stop - start, self.antialiased)
                done = self.backend.mark()
        finally:
            loader.shutdown()
            for arrays in slots:
                arrays.release()

    def _load_into(
        self,
        slots: list[_ChunkArrays],
        loader: Executor,
        done: Callable[[], None],
        start: int,
        stop: int,
        degree: int,
    ) -> Future[_ChunkArrays]:
        """Load a chunk on another thread, in place of the older of two, which `done` waits for the kernels of."""
        stride, arrays = padded(stop - start), None
        if len(slots) == 2:
            arrays = slots.pop(0)
            if (arrays.degree, arrays.stride) != (degree, stride):
                done()
                arrays.release()
                arrays = None
        arrays = arrays or _ChunkArrays(self.backend, degree, stride)
        slots.append(arrays)

        def load() -> _ChunkArrays:
            done()
            self._planes.load(start, stop, arrays.stored)
            return arrays

        return loader.submit(load)

    def refresh(self, *fields: str) -> None:
        """Read `sh_dc` or `sh_rest` again from a source whose values have changed (streamed chunks do so anyway)."""
        if not isinstance(self._planes, SourcePlanes):
            raise TypeError("only a scene with a source can be refreshed")
        for chunk in self._resident:
            names = [name for name in fields if FIELD[name].width(chunk.degree)]
            host = self._planes.source.read(slice(chunk.base, chunk.base + chunk.count), names)
            for name in names:
                for channel in range(FIELD[name].width(chunk.degree)):
                    self.backend.write(getattr(chunk, name), host[name][channel], channel * chunk.stride)

    def close(self) -> None:
        """Free everything."""
        self.evict()
        self.drop_statistics()
        self._planes.close()

    def __enter__(self) -> DeviceScene:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()
