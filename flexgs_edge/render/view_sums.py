"""Sums over views, chunk by chunk of the scene: added up view by view where memory holds them, else chunk by chunk.

In memory every view is added to the sums of all chunks as soon as it is drawn. Where these do not fit, what each row got in
each view is written to a file (only the rows that got something, 52 bytes at most), and read again chunk by chunk: then the sums
of one chunk are held at a time. Both add up the same numbers in the same order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, BinaryIO, Protocol

import numpy as np

from flexgs_edge.cameras import Camera
from flexgs_edge.kernels import Backend
from flexgs_edge.render.chunks import Chunk, padded
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.render.targets import to_half
from flexgs_edge.scratch import Room

SPOOL_ROWS = 1 << 16
"""Rows of a view that are read from the backend and written at a time."""


class ChunkSums(Protocol):
    """Sums over views of the rows of one chunk."""

    def add(self, chunk: Chunk, sums: Any, base: int) -> None:
        """Add the view that `Renderer.camera_array` tells of; the chunk's rows begin at row `base` of its `sums`."""

    def release(self) -> None:
        """Free what is held on the backend."""


Maker = Callable[[Chunk], ChunkSums]
Part = tuple[np.ndarray, np.ndarray]
"""Rows of a scene [m] u32, ascending, and what each got [m, planes] i64."""


@dataclass(frozen=True)
class Drawn:
    """A view that was drawn elsewhere."""

    parts: list[Part]
    picture: np.ndarray | None
    """[3, H, W] f16, as `TargetViews` keeps it: half the bytes to be sent."""


class ViewSums:
    """Sums over the views of a scene.

    Parameters
    ----------
    renderer, scene : Renderer, DeviceScene
    makers : sequence of callable
        Each makes one kind of sums for a chunk.
    """

    def __init__(self, renderer: Renderer, scene: DeviceScene, makers: Sequence[Maker]) -> None:
        self._renderer, self._scene, self._makers = renderer, scene, makers
        self._held: dict[int, tuple[int, list[ChunkSums]]] = {}
        self._spool: _Spool | None = None
        self._dense: _Dense | None = None

    def draw(
        self,
        kind: str,
        cameras: Sequence[Camera],
        targets: Callable[[int], np.ndarray] | None = None,
        pictures: bool = False,
    ) -> Iterator[Callable[[], np.ndarray]]:
        """Draw views and add them, one for each step of the iterator, in their order: here, or on the renderer's cluster.

        Parameters
        ----------
        kind : str
            Method of `Renderer` that gives a view's sums.
        targets : callable, optional
            The target of a view by its place among `cameras`, where that method wants one.
        pictures : bool
            Whether what is yielded will be asked for.

        Yields
        ------
        callable
            Gives the view for `TargetViews.add`; valid until the next step.
        """
        renderer, scene, cluster = self._renderer, self._scene, self._renderer.ready_cluster
        if cluster is None or scene.source is None:
            for view, camera in enumerate(renderer.in_turn(scene, cameras)):
                self.add_view(view_sums(renderer, scene, kind, camera, targets and targets(view)), camera)
                yield renderer.drawn_planes
            return
        found = cluster.sums(scene.source, kind, cameras, targets, pictures)
        for camera, drawn in zip(cameras, found, strict=True):
            self._add_drawn(drawn.parts, camera)
            yield partial(_picture, drawn)

    def add_view(self, sums: Any, camera: Camera) -> None:
        """Add the view drawn last, from `camera`. The order of views is part of the result."""
        if self._renderer.view_rows is not None:
            self._add_parts(view_parts(self._renderer, self._scene, sums), camera)
            return
        for chunk, held in self._chunks():
            for part in held:
                part.add(chunk, sums, chunk.base)

    def _chunks(self) -> Iterator[tuple[Chunk, list[ChunkSums]]]:
        """Chunks of the scene, and their sums in memory."""
        for chunk in self._scene.chunks():
            if chunk.base not in self._held:
                self._held[chunk.base] = (chunk.count, [make(chunk) for make in self._makers])
            yield chunk, self._held[chunk.base][1]

    def _add_drawn(self, parts: Sequence[Part], camera: Camera) -> None:
        """Add a view that was drawn elsewhere."""
        renderer, scene = self._renderer, self._scene
        if renderer.room.spills:
            self._add_parts(parts, camera)
            return
        if not parts:  # a compact view of nothing
            return
        renderer.aim(camera, scene.origin)
        for chunk, held in self._chunks():
            some = [slice(*np.searchsorted(rows, (chunk.base, chunk.base + chunk.count))) for rows, _ in parts]
            shape = chunk.stride, *parts[0][1].shape[1:]
            if self._dense is None or self._dense.shape != shape:
                self._drop_dense()
                self._dense = _Dense(renderer.backend, shape)
            inside = [(rows[at], values[at]) for (rows, values), at in zip(parts, some, strict=True)]
            sums = self._dense.of(inside, chunk.base)
            for part in held:
                part.add(chunk, sums, 0)

    def _drop_dense(self) -> None:
        if self._dense is not None:
            self._dense.release()
            self._dense = None

    def _add_parts(self, parts: Iterable[Part], camera: Camera) -> None:
        if self._spool is None:
            self._spool = _Spool(self._renderer.room, self._scene.starts)
        self._spool.add(parts, camera)

    def parts(self) -> Iterator[tuple[slice, list[Any]]]:
        """Rows of the scene and their sums over the views added, one of each kind, chunk by chunk; valid until the next."""
        if self._held:
            for base, (count, parts) in self._held.items():
                yield slice(base, base + count), parts
            return
        self._make_room()
        for chunk in self._scene.chunks():
            parts = [make(chunk) for make in self._makers]
            try:
                # Without a spool there was no view, and the sums are those of nothing.
                for sums in self._spool.replay(self._renderer, self._scene, chunk) if self._spool else ():
                    for part in parts:
                        part.add(chunk, sums, 0)
                yield slice(chunk.base, chunk.base + chunk.count), parts
            finally:
                for part in parts:
                    part.release()

    def _make_room(self) -> None:
        """Give up the buffers of the last view where the sums of a chunk have no place beside them."""
        renderer, scene = self._renderer, self._scene
        rows = padded(int(np.diff(scene.starts).max(initial=0)))
        if renderer.budget.free < scene.least_chunk_bytes + rows * scene.sum_bytes:
            scene.drop_statistics()
            renderer.release()

    def release(self) -> None:
        """Free what is held."""
        for _, parts in self._held.values():
            for part in parts:
                part.release()
        self._held = {}
        self._drop_dense()
        if self._spool is not None:
            self._spool.close()
            self._spool = None


class _Dense:
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


class _Spool:
    """What the rows of a scene got in some views, in a scratch file: view by view, rows ascending."""

    def __init__(self, room: Room, starts: np.ndarray) -> None:
        self._room, self._starts = room, starts
        self._record: np.dtype[Any] | None = None
        self._file: BinaryIO = room.file()
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
            raise self._room.full(self._end - start, error) from error
        self._room.count(self._end - self._counted)
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
        dense = _Dense(backend, (chunk.stride, *self._record["sums"].shape))
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
        self._room.count(-self._counted)


def view_sums(renderer: Renderer, scene: DeviceScene, kind: str, camera: Camera, target: np.ndarray | None) -> Any:
    """The sums of one view, by the method of `Renderer` that is called `kind`; a target where that wants one."""
    draw: Callable[..., Any] = getattr(renderer, kind)
    return draw(scene, camera) if target is None else draw(scene, camera, target)


def view_parts(renderer: Renderer, scene: DeviceScene, sums: Any) -> Iterator[Part]:
    """Rows that got something in the view drawn last, in their order, some at a time."""
    of_view, planes = renderer.view_rows, sums.shape[1]
    count = scene.count if of_view is None else len(of_view)
    for at in range(0, count, SPOOL_ROWS):
        words = np.empty((min(SPOOL_ROWS, count - at), planes, 2), np.uint32)
        values = renderer.backend.read(sums, words, 2 * planes * at).view(np.int64)[..., 0]
        got = values[:, 0].copy()
        for plane in range(1, planes):  # a twentieth to a fourth of the time of `values.any(axis=1)`
            got |= values[:, plane]
        some = np.flatnonzero(got)
        rows = at + some if of_view is None else of_view[at + some]
        yield rows.astype(np.uint32), values.take(some, axis=0)


def drawn_sums(
    renderer: Renderer, scene: DeviceScene, kind: str, camera: Camera, target: np.ndarray | None, picture: bool
) -> Drawn:
    """What a worker sends back of one view."""
    parts = list(view_parts(renderer, scene, view_sums(renderer, scene, kind, camera, target)))
    return Drawn(parts, to_half(renderer.drawn_planes()) if picture else None)


def _picture(drawn: Drawn) -> np.ndarray:
    assert drawn.picture is not None
    return drawn.picture
