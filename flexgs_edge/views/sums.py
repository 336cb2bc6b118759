"""Sums over views for each Gaussian, added up in memory if it has room, else through a scratch file.

In memory, each view is added to the sums of all chunks as soon as it is drawn. If they do not fit, we write each view's
sums to a file: only rows with a sum other than zero, at most 52 bytes each. Later we read the file chunk by chunk, and
hold the sums of one chunk at a time. Both ways add the same numbers in the same order.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, BinaryIO, Protocol

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.constants import ROW_BLOCK
from flexgs_edge.kernels.backend import Backend
from flexgs_edge.memory.storage import Storage
from flexgs_edge.render.chunks import Chunk, ViewPart
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.fit import padded
from flexgs_edge.render.renderer import Renderer

SPOOL_ROWS = 1 << 16  # Rows of a view that are copied from the backend at a time
Part = tuple[np.ndarray, np.ndarray]  # Rows of a scene ([m] u32, ascending) and their sums ([m, planes] i64)


def view_sums(renderer: Renderer, scene: DeviceScene, kind: str, camera: Camera, target: np.ndarray | None) -> Any:
    """The sums of one view by the method of `Renderer` with the name `kind`; some methods need a target."""
    draw: Callable[..., Any] = getattr(renderer, kind)
    return draw(scene, camera) if target is None else draw(scene, camera, target)


def view_parts(renderer: Renderer, scene: DeviceScene, sums: Any) -> Iterator[Part]:
    """Yield the rows with a sum other than zero in the last view, in row order, part by part."""
    of_view, planes = renderer.view_rows, sums.shape[1]
    count = scene.count if of_view is None else len(of_view)
    for at in range(0, count, SPOOL_ROWS):
        words = np.empty((min(SPOOL_ROWS, count - at), planes, 2), np.uint32)
        values = renderer.backend.read(sums, words, 2 * planes * at).view(np.int64)[..., 0]
        got = values[:, 0].copy()
        for plane in range(1, planes):  # much faster than `values.any(axis=1)`
            got |= values[:, plane]
        some = np.flatnonzero(got)
        rows = at + some if of_view is None else of_view[at + some]
        yield rows.astype(np.uint32), values.take(some, axis=0)


class DenseSums:
    """The sums of one view for all rows of a chunk, on the backend."""

    def __init__(self, backend: Backend, shape: tuple[int, ...]) -> None:
        self._backend, self.shape = backend, shape
        self._array = backend.array((*shape, 2), np.uint32)
        self._all = np.arange(-(-shape[0] // ROW_BLOCK), dtype=np.uint32)
        self._blocks = backend.array(self._all.shape, np.uint32)
        backend.write(self._blocks, self._all)

    def part(self, chunk: Chunk) -> ViewPart:
        """All rows of the chunk, as a part of a view."""
        return ViewPart.of(chunk, self._all[: chunk.blocks], 0, 0, self._blocks)

    def of(self, parts: Iterable[Part], base: int) -> Any:
        """Spread listed sums over all rows of the chunk that begins at row `base`; rows not listed get zero.

        Returns [stride, planes, 2] u32, valid until the next call.
        """
        self._backend.mark()()
        # Copying a row as one element is faster than plane by plane.
        row = np.dtype((np.void, 8 * self.shape[1]))
        with self._backend.mapped(self._array) as words:
            dense = words.view(np.int64)[..., 0]
            dense[...] = 0
            for rows, values in parts:
                dense.view(row)[rows.astype(np.int64) - base, 0] = values.view(row)[:, 0]
        return self._array

    def release(self) -> None:
        """Free the arrays."""
        self._array.release()
        self._blocks.release()


class Spool:
    """A scratch file with the sums of each view: view by view, rows ascending."""

    def __init__(self, storage: Storage, starts: np.ndarray) -> None:
        self._storage, self._starts = storage, starts
        self._record: np.dtype[Any] | None = None
        self._file: BinaryIO = storage.file()
        self._disk = ThreadPoolExecutor(1, "sums")
        """Reads or writes one block at a time, while this thread gathers the next block or adds the one before."""
        self._end = self._counted = 0
        # For each view: its camera, its first byte, and how many of its rows come before each chunk.
        self._views: list[tuple[Camera, int, np.ndarray]] = []

    def add(self, parts: Iterable[Part], camera: Camera) -> None:
        """Write one view."""
        start, before = self._end, np.zeros(len(self._starts), np.int64)
        written: Future[Any] = self._disk.submit(self._file.seek, start)
        try:
            for rows, values in parts:
                self._record = np.dtype([("row", "<u4"), ("sums", "<i8", values.shape[1:])])
                block = np.empty(len(rows), self._record)
                block["row"], block["sums"] = rows, values
                before += np.searchsorted(rows, self._starts)
                self._end += block.nbytes
                written.result()
                written = self._disk.submit(self._file.write, block.data)
            written.result()
            self._disk.submit(self._file.flush).result()
        except OSError as error:
            raise self._storage.full(self._end - start, error) from error
        self._storage.count(self._end - self._counted)
        self._counted = self._end
        self._views.append((camera, start, before))

    def replay(self, renderer: Renderer, scene: DeviceScene, chunk: Chunk) -> Iterator[tuple[Any, ViewPart]]:
        """Yield the sums of each view that shows a row of the chunk ([stride, planes, 2] u32 on the backend), and their rows."""
        backend, place = renderer.backend, int(np.searchsorted(self._starts, chunk.base))
        if self._record is None:  # no view showed anything
            return
        pieces = []
        for camera, start, before in self._views:
            low, high = before[place : place + 2].tolist()
            if low < high:
                pieces.append((camera, start + low * self._record.itemsize, high - low))
        if not pieces:
            return
        coming = self._disk.submit(self._read, *pieces[0][1:])
        dense = DenseSums(backend, (chunk.stride, *self._record["sums"].shape))
        try:
            for number, (camera, *_) in enumerate(pieces, start=1):
                block = coming.result()
                if number < len(pieces):
                    coming = self._disk.submit(self._read, *pieces[number][1:])
                renderer.aim(camera, scene.origin)
                yield dense.of([(block["row"], block["sums"])], chunk.base), dense.part(chunk)
        finally:
            dense.release()

    def _read(self, at: int, rows: int) -> np.ndarray:
        block = np.empty(rows, self._record)
        self._file.seek(at)
        self._file.readinto(block.data.cast("B"))  # type: ignore[attr-defined]
        return block

    def close(self) -> None:
        """Remove the scratch file."""
        self._disk.shutdown()
        self._file.close()
        self._storage.count(-self._counted)


class ChunkSums(Protocol):
    """Sums over views for the rows of one chunk."""

    def add(self, chunk: Chunk, sums: Any, part: ViewPart) -> None:
        """Add the view of `Renderer.camera_array`; `part` tells which of its `sums` are of the chunk."""

    def release(self) -> None:
        """Free the arrays on the backend."""


Maker = Callable[[Chunk], ChunkSums]


class ViewSums:
    """Sums over the views of a scene. `renderer`: draws the views. `makers`: each makes one kind of sums for a chunk."""

    def __init__(self, renderer: Renderer, scene: DeviceScene, makers: Sequence[Maker]) -> None:
        self._renderer, self._scene, self._makers = renderer, scene, makers
        scene.keep_chunks()
        self._held: dict[int, tuple[int, list[ChunkSums]]] = {}
        self._spool: Spool | None = None

    def draw(
        self,
        kind: str,  # name of the method of `Renderer` that gives a view's sums
        cameras: Sequence[Camera],
        references: Callable[[int], np.ndarray] | None = None,
    ) -> Iterator[Callable[[], np.ndarray]]:
        """Draw views and add their sums, one view for each step of the iterator, in order.

        `references`: gives the target of a view by its place among `cameras`, if that method takes one. Yields gives
        the view's picture for `References.add`; valid until the next step.
        """
        renderer, scene = self._renderer, self._scene
        for view, camera in enumerate(renderer.in_turn(scene, cameras)):
            self.add_view(view_sums(renderer, scene, kind, camera, references and references(view)), camera)
            yield renderer.drawn_planes

    def add_view(self, sums: Any, camera: Camera) -> None:
        """Add the sums of the last view, from `camera`. The order of views is part of the result."""
        parts = self._renderer.parts
        if parts is None:
            if self._spool is None:
                self._spool = Spool(self._renderer.storage, self._scene.starts)
            self._spool.add(view_parts(self._renderer, self._scene, sums), camera)
            return
        for chunk, held in self._chunks():
            if parts[chunk.base].count:
                for kind in held:
                    kind.add(chunk, sums, parts[chunk.base])

    def _chunks(self) -> Iterator[tuple[Chunk, list[ChunkSums]]]:
        """Yield each chunk of the scene with its sums in memory, allocated at the first call."""
        for chunk in self._scene.chunks():
            if chunk.base not in self._held:
                self._held[chunk.base] = (chunk.count, [make(chunk) for make in self._makers])
            yield chunk, self._held[chunk.base][1]

    def parts(self) -> Iterator[tuple[slice, list[Any]]]:
        """Yield rows of the scene and their sums over all views, one of each kind, chunk by chunk.

        The sums are valid until the next step.
        """
        if self._held:
            for base, (count, parts) in self._held.items():
                yield slice(base, base + count), parts
            return
        self._make_room()
        for chunk in self._scene.chunks():
            parts = [make(chunk) for make in self._makers]
            try:
                # No spool means that no view was added: the sums stay zero.
                for sums, rows in self._spool.replay(self._renderer, self._scene, chunk) if self._spool else ():
                    for part in parts:
                        part.add(chunk, sums, rows)
                yield slice(chunk.base, chunk.base + chunk.count), parts
            finally:
                for part in parts:
                    part.release()

    def _make_room(self) -> None:
        """Free the buffers of the last view if the sums of a chunk do not fit beside them."""
        renderer, scene = self._renderer, self._scene
        rows = padded(int(np.diff(scene.starts).max(initial=0)))
        if renderer.budget.free < scene.least_chunk_bytes + rows * scene.sum_bytes:
            scene.drop_statistics()
            renderer.release()

    def release(self) -> None:
        """Free the sums and the scratch file."""
        for _, parts in self._held.values():
            for part in parts:
                part.release()
        self._held = {}
        if self._spool is not None:
            self._spool.close()
            self._spool = None
