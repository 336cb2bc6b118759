"""Compact views: buffers that hold only the splats that a view shows, for views with no room for all rows of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from flexgs_edge.constants import CULLED, ROW_BLOCK
from flexgs_edge.kernels.backend import Backend
from flexgs_edge.render.chunk_bounds import ChunkBounds
from flexgs_edge.render.chunks import ViewPart
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.fit import chunk_shapes
from flexgs_edge.render.view_buffers import ViewBuffers

Splats = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Splats that a view shows: records [m, 16] f32, depth keys and bounds of tiles [m] u32, rows of the scene [m] u32."""


class CompactView(Protocol):
    """A view that collects its splats, chunk by chunk, in row order."""

    record: np.ndarray
    """[32] f32, from `camera_record`."""
    camera: Any
    """The same record on the backend."""
    count: int
    """Splats that the view shows so far."""

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
        """[count] u32, the splats' rows of the scene."""
        return np.concatenate(self._rows) if self._rows else np.zeros(0, np.uint32)


def fill_compact(
    backend: Backend, scene: DeviceScene, buffers: ViewBuffers, views: Sequence[CompactView], inria_extent: int
) -> int:
    """Project the scene chunk by chunk, and give each view the splats that it shows, in row order.

    Returns the row of the scene that was reached. It stops early if a view has no more room.
    """

    def wanted(bounds: ChunkBounds) -> bool:
        return any(bounds.seen(view.record, bool(inria_extent)).any() for view in views)

    out, blocks = buffers.chunk, buffers.blocks(-(-scene.compact_rows // ROW_BLOCK))
    # Kept for all chunks: fresh pages for each one take longer than the copies.
    on_host = [np.empty(shape, dtype) for shape, dtype in chunk_shapes(out[0].shape[0]).values()]
    for chunk in scene.chunks(wanted):
        for view in views:
            seen = scene.blocks_seen(chunk, view.record, inria_extent)
            part = ViewPart.of(chunk, seen, 0, 0, blocks)
            backend.write(blocks, seen)
            chunk.project(backend, view.camera, part, inria_extent, scene.antialiased, out)
            records, keys, bounds = map(backend.read, out, (values[: part.count] for values in on_host))
            shown = np.flatnonzero(keys != CULLED)
            rows = part.rows.take(shown)
            # `take` is much faster than `records[shown]`.
            if not view.put((records.take(shown, axis=0), keys.take(shown), bounds.take(shown), rows)):
                return chunk.base + chunk.count
    return scene.count
