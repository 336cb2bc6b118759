"""A scene on the backend, in chunks: it stays there if it fits into the budget, else each view streams it anew."""

import hashlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from typing import Any

import numpy as np

from flexgs_edge.constants import LANES, ROW_BLOCK
from flexgs_edge.kernels.backend import Backend
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.render import fit as fit_module
from flexgs_edge.render.chunk_loads import ChunkLoads
from flexgs_edge.render.chunks import Chunk, ChunkArrays, ChunkBounds, ChunkPlanes, SourcePlanes
from flexgs_edge.render.fit import (
    AHEAD_SHARE,
    MOST_SUMS,
    RAW_BYTES,
    SUM_BYTES,
    Fit,
    padded,
    plane_bytes,
    streamed_bytes,
    sum_bytes,
)
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import SceneSource


class DeviceScene(AbstractContextManager["DeviceScene"]):
    """A scene on a backend. Iterate over `chunks()` for every view; close when done.

    The first view decides, from the memory that it leaves free, whether the scene stays on the backend or is streamed.
    The result is the same.

    `antialiased`: draw with antialiasing; `cov` of the chunks then holds the factor of the covariance. `references`:
    views will be compared with targets on the backend; their room is taken with the view's buffers.
    """

    def __init__(
        self,
        backend: Backend,
        planes: ChunkPlanes,  # loads each chunk: once if the scene fits into the budget, else once a view
        budget: MemoryBudget,
        antialiased: bool = False,
        sum_bytes: int = SUM_BYTES,  # bytes a row that sums over views will take on the backend, to be left free
        references: bool = False,
        structure: bool = False,  # they will be compared by their structure, too (`Renderer.gradient_sums`)
        view_sums: int = MOST_SUMS,  # most planes of sums that a view has
        fit: Fit | None = None,  # how the scene shares memory with its views
    ) -> None:
        self.backend = backend
        self.count = planes.count
        self.sh_degree = planes.sh_degree if planes.sh_count else 0
        self.origin = planes.origin
        self.antialiased = antialiased
        self.statistics: list[Any] = []
        self.resident, self._streamed = False, False
        self.references, self.structure = references, structure
        self.sum_bytes = sum_bytes
        self.view_sums = view_sums
        self.fit = fit or fit_module.DEFAULT
        self.changes = 0  # How many times the values have changed
        self.shown: int | None = None  # Rows that a compact view has room for; None while views have room for all rows
        self._planes = planes
        self._budget = budget
        self._resident: list[Chunk] = []
        self._pinned: dict[int, Chunk] = {}  # Chunks of a compact scene that stay on the backend, by their first rows
        self._drawn = -1  # First row of the chunk in use, -1 if none is; `give_way` must not free it
        self._stays = self._keeps_chunks = False
        self._rows = 0
        self._chunk_row_bytes = streamed_bytes(planes.sh_degree)
        self._least_rows = min(self.fit.least_rows, max(self.count, 1))

    @property
    def source(self) -> SceneSource | None:
        """The source of the values; None if they are codes on the backend."""
        return self._planes.source if isinstance(self._planes, SourcePlanes) else None

    @property
    def least_bytes(self) -> int:
        """Bytes that a view must leave to the scene: none once it is loaded, else its smallest chunk."""
        return 0 if self._resident else self.least_chunk_bytes

    @property
    def least_chunk_bytes(self) -> int:
        """Bytes of the smallest chunk of the streamed scene."""
        return padded(self._least_rows) * self._chunk_row_bytes

    @property
    def compact_rows(self) -> int:
        """Rows of a chunk once the scene's views are compact."""
        return padded(min(self.fit.compact_rows, max(self.count, 1)))

    @property
    def compact_chunk_bytes(self) -> int:
        """Bytes of a chunk once the scene's views are compact."""
        return self.compact_rows * self._chunk_row_bytes

    @property
    def whole_bytes(self) -> int:
        """Bytes of all chunks when loaded."""
        planes = self._planes
        whole = planes.sh_count * plane_bytes(planes.sh_degree) + (self.count - planes.sh_count) * plane_bytes(0)
        # At most two chunks are padded: the last one with SH and the last one without.
        return whole + 2 * LANES * self._chunk_row_bytes

    @property
    def later_bytes(self) -> int:
        """Bytes that sums over views will take: none after the first view, which allocates them."""
        return 0 if self.statistics else self.sum_bytes * self.count

    @property
    def shown_bytes(self) -> int:
        """Bytes of one view's sums for each row that a compact view shows; the sums over all views are not counted."""
        return 0 if self.statistics else min(self.sum_bytes, sum_bytes(self.view_sums))

    @property
    def held_bytes(self) -> int:
        """Bytes that the loaded chunks take now."""
        held = (*self._resident, *self._pinned.values())
        return sum(array.nbytes for chunk in held for array in chunk.arrays)

    def fingerprint(self) -> bytes | None:
        """Digest of everything that views are drawn from.

        It covers the chunks on the backend, and the stored values of a scene that is streamed.

        Returns `None` if nothing is on the backend and there is no source.
        """
        source = self.source
        if source is not None and self._streamed:
            words = source.count, source.sh_count, source.sh_degree, source.origin.tolist(), self.antialiased
            digest = hashlib.sha256(repr(words).encode())
            for rows in source.chunks(self.fit.compact_rows):
                for values in source.read(rows, list(FIELD)).values():
                    digest.update(np.ascontiguousarray(values).data)
            return digest.digest()
        if not self.resident:
            return None
        digest = hashlib.sha256(repr((self.count, self.origin.tolist(), self.antialiased)).encode())
        for chunk in self._resident:
            digest.update(repr((chunk.base, chunk.count, chunk.degree)).encode())
            for array in chunk.arrays:
                digest.update(self.backend.read(array)[..., : chunk.count].tobytes())
        return digest.digest()

    def be_compact(self, shown: int) -> None:
        """Make views compact from now on, with room for `shown` rows at first; the scene is then streamed."""
        self.evict()
        self._planes.bounds.clear()  # chunks that begin at the same rows were larger
        self.shown = shown
        self._least_rows = min(self.fit.compact_rows, max(self.count, 1))
        if self.give_way not in self._budget.reclaimers:
            self._budget.reclaimers.insert(0, self.give_way)  # cached chunks go before anything that costs drawing

    def drop_statistics(self) -> None:
        """Free the sums of the last view."""
        for array in self.statistics:
            array.release()
        self.statistics = []

    def _decide(self) -> None:
        """Load the scene if it fits, else choose the rows of a streamed chunk; later views of this size keep that number."""
        budget, later = self._budget, self.later_bytes
        if self.shown is not None:
            self._rows, self._streamed = self._least_rows, True
            return
        most = min(self.fit.chunk_rows, max(self.count, 1))
        whole = self.whole_bytes + later
        fits = self.fit.resident and budget.free >= whole + padded(self._rows or self._least_rows) * RAW_BYTES
        if not self._rows:
            spare = budget.free - whole if fits else budget.free - later
            per_row = RAW_BYTES if fits else self._chunk_row_bytes
            # Whole vectors: then only the last chunks with and without SH are padded.
            self._rows = max(min(most, (spare // per_row // LANES - 2) * LANES), self._least_rows)
        if fits:
            self._resident = [self._load(*span) for span in self.spans()]
            self._budget.evictors.append(self.evict)
        # Fixed here: in the middle of a view, a part of the memory it left free is taken, and the answer would change.
        self.resident, self._streamed = fits, not fits

    def choose_rows_anew(self) -> None:
        """Let the next view choose the rows of a chunk again, as new buffers leave other room, unless chunks are kept."""
        if not self._resident and not self._keeps_chunks and self.shown is None:
            self._rows, self._streamed = 0, False
            self._planes.bounds.clear()

    def stay(self) -> None:
        """Keep the loaded scene on the backend until it is closed, as its values will change there."""
        self._stays = True

    def keep_chunks(self) -> None:
        """Cut the scene into the same chunks for all views from now on, as sums over views belong to them."""
        self._keeps_chunks = True

    def evict(self) -> None:
        """Free a loaded scene, unless it has to `stay`; the next view decides again whether it fits."""
        if self._stays:
            return
        for chunk in (*self._resident, *self._pinned.values()):
            chunk.release()
        self._resident, self._pinned, self.resident, self._streamed = [], {}, False, False
        if self.evict in self._budget.evictors:
            self._budget.evictors.remove(self.evict)

    def give_way(self, size: int) -> None:
        """Free `size` bytes of chunks that stay, or as many as there are; the chunk in use is kept."""
        for base in sorted(self._pinned.keys() - {self._drawn}, reverse=True):
            if size <= 0:
                return
            chunk = self._pinned.pop(base)
            size -= sum(array.nbytes for array in chunk.arrays)
            chunk.release()

    def _may_stay(self, rows: int) -> bool:
        """Whether memory has room for one more chunk that stays."""
        return self._leaves_free(rows, self.fit.spare_share)

    def _may_add(self, rows: int) -> bool:
        """Whether memory has room for one more chunk until the view is projected."""
        return self._leaves_free(rows, AHEAD_SHARE)

    def _leaves_free(self, rows: int, share: int) -> bool:
        size = padded(rows) * self._chunk_row_bytes // 2
        return self.shown is not None and self._budget.free - size >= self._budget.limit // share

    def spans(self) -> Iterator[tuple[int, int, int]]:
        """Yield (start, stop, degree) of each chunk: first the rows with SH, then those without."""
        if not self._rows:
            self._decide()
        planes = self._planes
        parts = ((0, planes.sh_count, planes.sh_degree), (planes.sh_count, planes.count, 0))
        for first, last, degree in parts:
            for start in range(first, last, self._rows):
                yield start, min(start + self._rows, last), degree

    def blocks_seen(self, chunk: Chunk, record: np.ndarray | None) -> np.ndarray:
        """[.] u32, the blocks of a chunk that a view may show, by its `camera_record`; all of them for None."""
        bounds = self._planes.bounds.get(chunk.base)
        if record is None or bounds is None:
            return np.arange(chunk.blocks, dtype=np.uint32)
        return np.flatnonzero(bounds.seen(record)).astype(np.uint32)

    @property
    def blocks(self) -> int:
        """Blocks of all chunks."""
        return sum(-(-(stop - start) // ROW_BLOCK) for start, stop, _ in self.spans())

    @property
    def starts(self) -> np.ndarray:
        """[chunks + 1] i64: the first row of every chunk, then the number of rows."""
        return np.array([*(start for start, _, _ in self.spans()), self.count], np.int64)

    def _load(self, start: int, stop: int, degree: int) -> Chunk:
        """Load a chunk that stays."""
        arrays = ChunkArrays(self.backend, degree, padded(stop - start))
        self._planes.load(start, stop, arrays.stored)
        chunk = arrays.activated(start, stop - start, self.antialiased)
        arrays.release_raw()
        return chunk

    def chunks(self, wanted: Callable[[ChunkBounds], bool] | None = None) -> Iterator[Chunk]:
        """Yield the chunks in row order; a streamed chunk is valid until the next one is asked for.

        A streamed chunk loads while the one before it is drawn. If its bounds are known and not `wanted`, it is skipped
        and not read.
        """
        if not self.resident and not self._streamed:
            self._decide()
        if self.resident:
            yield from self._resident
            return
        bounds = self._planes.bounds
        spans = [span for span in self.spans() if wanted is None or span[0] not in bounds or wanted(bounds[span[0]])]
        loads = ChunkLoads(self.backend, self._planes, self._may_stay, self._may_add)
        try:
            for place, span in enumerate(spans):
                start, stop, _ = span
                self._drawn = start
                loading = None if start in self._pinned else loads.take(span)
                loads.go_on(later for later in spans[place + 1 :] if later[0] not in self._pinned)
                if loading is None:
                    yield self._pinned[start]
                    continue
                chunk = loading.arrays.activated(start, stop - start, self.antialiased)
                if loading.stays:
                    loads.keep(loading)
                    loading.arrays.release_raw()
                    self._pinned[start] = chunk
                yield chunk
                if not loading.stays:
                    loads.give_back(loading)
        finally:
            self._drawn = -1
            loads.close()

    def refresh(self, *fields: str) -> None:
        """Read `sh_dc` or `sh_rest` again after the source's values changed. Streamed chunks are read again in any case."""
        if not isinstance(self._planes, SourcePlanes):
            raise TypeError("only a scene with a source can be refreshed")
        self.changes += 1
        for chunk in (*self._resident, *self._pinned.values()):
            names = [name for name in fields if FIELD[name].width(chunk.degree)]
            host = self._planes.source.read(slice(chunk.base, chunk.base + chunk.count), names)
            for name in names:
                for channel in range(FIELD[name].width(chunk.degree)):
                    self.backend.write(getattr(chunk, name), host[name][channel], channel * chunk.stride)

    def close(self) -> None:
        """Free everything."""
        self._stays = False
        self.evict()
        if self.give_way in self._budget.reclaimers:
            self._budget.reclaimers.remove(self.give_way)
        self.drop_statistics()
        self._planes.close()

    def __exit__(self, *exc: object) -> None:
        self.close()
