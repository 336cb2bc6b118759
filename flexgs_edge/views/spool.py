"""Keep the sums of single views in a scratch file until they are added up, chunk by chunk."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, BinaryIO

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.constants import ROW_BLOCK
from flexgs_edge.kernels.backend import Backend
from flexgs_edge.memory.storage import Storage
from flexgs_edge.render.chunks import Chunk, ViewPart
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.views.one_view import Part


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
