"""Project the next views together with the current one, so that a streamed scene is read once for several views.

A scene in scratch files costs a read per view. Here each chunk that is read is also projected for the views that come
next. Their splats wait in a scratch file: 76 bytes a splat, where reading a row again takes 236 (at SH degree 3).
Reading again would also cost that much for every row that the view does not show.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from functools import partial
from typing import Any, BinaryIO, Protocol

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.constants import CULLED, JACOBIAN_MARGIN, ROW_BLOCK
from flexgs_edge.kernels.backend import Backend
from flexgs_edge.memory.storage import Storage
from flexgs_edge.render.chunks import ChunkBounds, ViewPart
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.fit import chunk_shapes, shapes_bytes
from flexgs_edge.render.view_buffers import ViewBuffers
from flexgs_edge.small_matrices import product

AHEAD_ROW_BYTES = shapes_bytes(chunk_shapes(1)) + 4
"""Bytes that one waiting splat takes in the scratch file, its row number included."""


def camera_record(camera: Camera, origin: np.ndarray, near: float) -> np.ndarray:
    """Compute the 32 floats that `project` reads, in float64, and round them once.

    `camera`: in world coordinates. `origin`: [3] f64, the world point that the scene is centred at. `near`: near plane,
    scene units. Returns [32] f32.
    """
    x_low = -(camera.cx + 0.5) / camera.fx - JACOBIAN_MARGIN * camera.width / camera.fx
    x_high = (camera.width - 0.5 - camera.cx) / camera.fx + JACOBIAN_MARGIN * camera.width / camera.fx
    y_low = -(camera.cy + 0.5) / camera.fy - JACOBIAN_MARGIN * camera.height / camera.fy
    y_high = (camera.height - 0.5 - camera.cy) / camera.fy + JACOBIAN_MARGIN * camera.height / camera.fy
    record = np.zeros(32)
    record[0:9] = camera.rotation.reshape(-1)
    record[9:12] = shift = camera.translation + product(camera.rotation, origin)
    record[12:16] = camera.fx, camera.fy, camera.cx, camera.cy
    record[16:21] = near, x_low, x_high, y_low, y_high
    record[21:24] = product(-camera.rotation.T, shift)  # the transpose as inverse is exact enough near the origin
    record[24:27] = camera.width, camera.height, camera.dilation
    return record.astype(np.float32)


Splats = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Splats that a view shows: records [m, 16] f32, depth keys and bounds of tiles [m] u32, rows of the scene [m] u32."""


class CompactView(Protocol):
    """A view that collects its splats, chunk by chunk, in row order."""

    record: np.ndarray  # [32] f32, from `camera_record`
    camera: Any  # The same record on the backend
    count: int  # Splats that the view shows so far

    def put(self, splats: Splats) -> bool:
        """Append the splats of a chunk that the view shows; False if there is no room for them."""


class ShownView:
    """The current view, which collects its splats in its own buffers."""

    def __init__(self, backend: Backend, buffers: ViewBuffers, record: np.ndarray) -> None:
        self._backend, self._buffers = backend, buffers
        self.record, self.camera = record, buffers.camera
        self.count = 0
        self._rows: list[np.ndarray] = []

    def put(self, splats: Splats) -> bool:
        at, buffers = self.count, self._buffers
        records, keys, bounds, rows = splats
        assert buffers.rows is not None
        self.count += len(rows)
        if self.count > buffers.rows:
            return False
        self._backend.write(buffers.records, records, 16 * at)
        self._backend.write(buffers.keys, keys, at)
        self._backend.write(buffers.bounds, bounds, at)
        self._rows.append(rows)
        return True

    @property
    def rows(self) -> np.ndarray:
        """[count] u32, the splats' rows of the scene."""
        return np.concatenate(self._rows) if self._rows else np.zeros(0, np.uint32)


def fill_compact(backend: Backend, scene: DeviceScene, buffers: ViewBuffers, views: Sequence[CompactView]) -> int:
    """Project the scene chunk by chunk, and give each view the splats that it shows, in row order.

    Returns the row of the scene that was reached. It stops early if a view has no more room.
    """

    def wanted(bounds: ChunkBounds) -> bool:
        return any(bounds.seen(view.record).any() for view in views)

    out, blocks = buffers.chunk, buffers.blocks(-(-scene.compact_rows // ROW_BLOCK))
    # Kept for all chunks: fresh pages for each one take longer than the copies.
    on_host = [np.empty(shape, dtype) for shape, dtype in chunk_shapes(out[0].shape[0]).values()]
    for chunk in scene.chunks(wanted):
        for view in views:
            seen = scene.blocks_seen(chunk, view.record)
            part = ViewPart.of(chunk, seen, 0, 0, blocks)
            backend.write(blocks, seen)
            chunk.project(backend, view.camera, part, scene.antialiased, out)
            records, keys, bounds = map(backend.read, out, (values[: part.count] for values in on_host))
            shown = np.flatnonzero(keys != CULLED)
            rows = part.rows.take(shown)
            # `take` is much faster than `records[shown]`.
            if not view.put((records.take(shown, axis=0), keys.take(shown), bounds.take(shown), rows)):
                return chunk.base + chunk.count
    return scene.count


class WaitingView:
    """A compact view that is projected already and waits for its turn; its splats lie in a scratch file. Close it when done."""

    def __init__(self, backend: Backend, storage: Storage, camera: Camera, record: np.ndarray) -> None:
        self.of = camera
        self.record, self.camera = record, backend.array(record.shape, np.float32)
        backend.write(self.camera, record)
        self.count = 0
        self._backend, self._storage = backend, storage
        self._parts: list[int] = []
        self._file: BinaryIO = storage.file()
        self._disk = ThreadPoolExecutor(1, "ahead")
        self._written: Future[None] | None = None

    def put(self, splats: Splats) -> bool:
        """Append splats (see `CompactView.put`); the disk writes them while the next chunk is projected."""
        self._wait()
        if len(splats[0]):
            self._written = self._disk.submit(self._move, os.pwritev, splats, self.count * AHEAD_ROW_BYTES)
            self._parts.append(len(splats[0]))
            self.count += len(splats[0])
            self._storage.count(AHEAD_ROW_BYTES * len(splats[0]))
        return True

    def fill(self, buffers: ViewBuffers) -> np.ndarray:
        """Copy all splats into the buffers of a view, which must have room for them.

        Returns [count] u32, the splats' rows of the scene.
        """
        self._wait()
        self._backend.mark()()  # the view before may still be drawn from these buffers
        rows, at = np.empty(self.count, np.uint32), 0
        with ExitStack() as maps:
            arrays = buffers.records, buffers.keys, buffers.bounds
            held = [*(maps.enter_context(self._backend.mapped(array)) for array in arrays), rows]
            for count in self._parts:
                self._move(os.preadv, [values[at : at + count] for values in held], at * AHEAD_ROW_BYTES)
                at += count
        return rows

    def _move(self, call: Callable[..., int], parts: Sequence[np.ndarray], at: int) -> None:
        left = [part.data.cast("B") for part in parts]
        while left:
            try:
                done = call(self._file.fileno(), left, at)
            except OSError as error:
                raise self._storage.full(sum(map(len, left)), error) from error
            if not done:
                raise EOFError(f"a scratch file ends at byte {at}")
            at += done
            while left and done >= len(left[0]):
                done -= len(left.pop(0))
            if left:
                left[0] = left[0][done:]

    def _wait(self) -> None:
        written, self._written = self._written, None
        if written is not None:
            written.result()

    def close(self) -> None:
        """Remove the scratch file."""
        self._disk.shutdown()
        self._file.close()
        self._storage.count(-AHEAD_ROW_BYTES * self.count)
        self.camera.release()


class ViewsAhead:
    """Projects compact views, and the next ones with them if keeping their splats is cheaper than reading the scene again."""

    def __init__(self, backend: Backend, ahead: int) -> None:
        self._backend, self._most = backend, ahead
        self._scene: tuple[DeviceScene, int] | None = None
        """The scene whose views are drawn in turn, and its `changes` when the views began to wait."""
        self._coming: Sequence[Camera] = ()
        self._waiting: list[WaitingView] = []

    def in_turn(self, scene: DeviceScene, cameras: Sequence[Camera]) -> Iterator[Camera]:
        """Yield each camera when its view is to be drawn; in the end, drop the views that still wait."""
        try:
            for place, camera in enumerate(cameras):
                if self._scene != (scene, scene.changes):
                    self.drop()
                    self._scene = scene, scene.changes
                self._coming = cameras[place + 1 : place + 1 + self._most]
                yield camera
        finally:
            self.drop()

    def fill(
        self, scene: DeviceScene, camera: Camera, buffers: ViewBuffers, storage: Storage, near: float
    ) -> tuple[int, int, np.ndarray | None]:
        """Put the splats that a view shows into its buffers.

        Returns the number of splats, the row of the scene up to which they were counted, and their rows ([m] u32). The
        rows are None if the buffers have no room.
        """
        assert buffers.rows is not None
        record = camera_record(camera, scene.origin, near)
        self._backend.write(buffers.camera, record)
        project = partial(fill_compact, self._backend, scene, buffers)
        in_turn = self._scene == (scene, scene.changes)
        waiting = next((view for view in self._waiting if view.of is camera), None) if in_turn else None
        if waiting is None:
            may_wait = in_turn and storage.spills and scene.source is not None and hasattr(os, "pwritev")
            coming = [self._wait(later, scene, storage, near) for later in self._coming] if may_wait else []
            shown = ShownView(self._backend, buffers, record)
            seen = project((shown, *coming))
            if shown.count <= buffers.rows:
                return shown.count, seen, shown.rows
            if not may_wait:
                return shown.count, seen, None
            # How many there are tells a pass that has room for all of them.
            waiting, *coming = (self._wait(later, scene, storage, near) for later in (camera, *self._coming))
            project((waiting, *coming))
        if waiting.count > buffers.rows:
            return max(view.count for view in self._waiting), scene.count, None
        self._waiting.remove(waiting)
        try:
            return waiting.count, scene.count, waiting.fill(buffers)
        finally:
            waiting.close()

    def _wait(self, camera: Camera, scene: DeviceScene, storage: Storage, near: float) -> WaitingView:
        """Let a view wait, in place of an earlier wait of the same view."""
        for view in [view for view in self._waiting if view.of is camera]:
            self._waiting.remove(view)
            view.close()
        self._waiting.append(WaitingView(self._backend, storage, camera, camera_record(camera, scene.origin, near)))
        return self._waiting[-1]

    def drop(self) -> None:
        """Drop all waiting views."""
        self._scene, self._coming = None, ()
        for view in self._waiting:
            view.close()
        self._waiting = []
