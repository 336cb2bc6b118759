"""Where sums over views wait: in memory as a whole, or in a scratch file by chunk."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, BinaryIO

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.kernels.backend import Backend
from flexgs_edge.memory.storage import Storage
from flexgs_edge.render.chunks import Chunk
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.views.one_view import Part


class DenseSums:
    """Sums of one view of all rows of a chunk, on the backend."""

    def __init__(self, backend: Backend, shape: tuple[int, ...]) -> None:
        self._backend, self.shape = backend, shape
        self._array = backend.array((*shape, 2), np.uint32)

    def of(self, parts: Iterable[Part], base: int) -> Any:
        """[stride, planes, 2] u32, valid until the next; the chunk begins at row `base`, and rows not listed got nothing."""
        self._backend.mark()()
        # A row as one element: less than half of the time.
        row = np.dtype((np.void, 8 * self.shape[1]))
        with self._backend.mapped(self._array) as words:
            dense = words.view(np.int64)[..., 0]
            dense[...] = 0
            for rows, values in parts:
                dense.view(row)[rows.astype(np.int64) - base, 0] = values.view(row)[:, 0]
        return self._array

    def release(self) -> None:
        """Free it."""
        self._array.release()


class Spool:
    """What the rows of a scene got in some views, in a scratch file: view by view, rows ascending."""

    def __init__(self, storage: Storage, starts: np.ndarray) -> None:
        self._storage, self._starts = storage, starts
        self._record: np.dtype[Any] | None = None
        self._file: BinaryIO = storage.file()
        self._disk = ThreadPoolExecutor(1, "sums")
        """Writes and reads it, one block at a time, while the next is gathered or the one before is added."""
        self._end = self._counted = 0
        # For each view: its camera, where it begins, and how many of its rows come before each chunk.
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

    def replay(self, renderer: Renderer, scene: DeviceScene, chunk: Chunk) -> Iterator[Any]:
        """For each view in which a row of the chunk got something: its sums, [stride, planes, 2] u32 on the backend."""
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
                yield dense.of([(block["row"], block["sums"])], chunk.base)
        finally:
            dense.release()

    def _read(self, at: int, rows: int) -> np.ndarray:
        block = np.empty(rows, self._record)
        self._file.seek(at)
        self._file.readinto(block.data.cast("B"))  # type: ignore[attr-defined]
        return block

    def close(self) -> None:
        """Remove the file."""
        self._disk.shutdown()
        self._file.close()
        self._storage.count(-self._counted)
