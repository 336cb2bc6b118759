"""Views that hold the splats that they show, and no other rows of the scene."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from flexgs_edge.constants import CULLED
from flexgs_edge.kernels.backend import Backend
from flexgs_edge.render.chunk_bounds import ChunkBounds
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.fit import chunk_shapes
from flexgs_edge.render.view_buffers import ViewBuffers

Splats = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Of some rows that a view shows: records [m, 16] f32, depth keys and bounds of tiles [m] u32, rows of the scene [m] u32."""


class CompactView(Protocol):
    """A view that takes what it shows, chunk by chunk, in the order of rows."""

    record: np.ndarray
    """[32] f32, from `camera_record`."""
    camera: Any
    """The same on the backend."""
    count: int
    """Rows that it shows."""

    def put(self, splats: Splats) -> bool:
        """Append the rows that it shows of a chunk; False where there is no room for them."""


class ShownView:
    """The view whose turn it is, in its buffers."""

    def __init__(self, backend: Backend, buffers: ViewBuffers, record: np.ndarray) -> None:
        self._backend, self._buffers = backend, buffers
        self.record, self.camera = record, buffers.camera
        self.count = 0
        self._rows: list[np.ndarray] = []

    def put(self, splats: Splats) -> bool:
        """See `CompactView.put`."""
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
        """[count] u32, rows of the scene."""
        return np.concatenate(self._rows) if self._rows else np.zeros(0, np.uint32)


def fill_compact(
    backend: Backend, scene: DeviceScene, out: tuple[Any, ...], views: Sequence[CompactView], inria_extent: int
) -> int:
    """Put the splats that each of some views shows where they belong, in the order of their rows.

    Parameters
    ----------
    out : tuple
        `ViewBuffers.chunk`, which a chunk is projected to for one view after the other.

    Returns
    -------
    int
        Up to which row of the scene: where one of the views has no more room, it stops.
    """

    def wanted(bounds: ChunkBounds) -> bool:
        return any(bounds.seen(view.record, bool(inria_extent)) for view in views)

    # Made once: fresh pages for every chunk took longer than the copies.
    on_host = [np.empty(shape, dtype) for shape, dtype in chunk_shapes(out[0].shape[0]).values()]
    for chunk in scene.chunks(wanted):
        for view in views:
            chunk.project(backend, view.camera, 0, inria_extent, scene.antialiased, out)
            records, keys, bounds = map(backend.read, out, (values[: chunk.count] for values in on_host))
            shown = np.flatnonzero(keys != CULLED)
            rows = (chunk.base + shown).astype(np.uint32)
            # `take` is much faster than `records[shown]`.
            if not view.put((records.take(shown, axis=0), keys.take(shown), bounds.take(shown), rows)):
                return chunk.base + chunk.count
    return scene.count
