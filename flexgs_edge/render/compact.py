"""Views that hold the splats that they show, and no other rows of the scene."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from flexgs_edge.constants import CULLED
from flexgs_edge.kernels import Backend
from flexgs_edge.render.chunk_bounds import ChunkBounds
from flexgs_edge.render.chunks import Chunk
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.view_buffers import ViewBuffers, chunk_shapes

CAPACITY_STEP = 1 << 16
"""Compact views make room for multiples of so many rows: views of about one size then share their buffers."""
FIRST_SHARE = 4
"""Part of a scene's rows (one in four) that a compact view has room for until one shows more."""
GROWTH = 1.1
"""Room beyond what the part of a view that was seen lets expect."""
GUESS = 1.02
"""Room beyond what views have shown so far."""


def capacity(scene: DeviceScene, share: float) -> int:
    """Rows that a compact view of some of a scene's rows gets room for."""
    return min((int(share * scene.count) // CAPACITY_STEP + 1) * CAPACITY_STEP, scene.count)


def fill_compact(
    backend: Backend,
    scene: DeviceScene,
    buffers: ViewBuffers,
    wanted: Callable[[ChunkBounds], bool],
    project: Callable[[Chunk, tuple[Any, ...]], None],
) -> tuple[np.ndarray, int]:
    """Put the splats that a view shows into its buffers, in the order of their rows.

    Parameters
    ----------
    wanted : callable
        Whether a chunk with such bounds may be seen.
    project : callable
        Projects a chunk to `buffers.chunk`.

    Returns
    -------
    tuple
        [m] u32, rows shown, and up to which row of the scene: where they are more than there is room for, it stops.
    """
    assert buffers.rows is not None
    found: list[np.ndarray] = []
    at = 0
    # Made once: fresh pages for every chunk took longer than the copies.
    on_host = [np.empty(shape, dtype) for shape, dtype in chunk_shapes(buffers.chunk[0].shape[0]).values()]
    for chunk in scene.chunks(wanted):
        project(chunk, buffers.chunk)
        splats, depths, counts = map(backend.read, buffers.chunk, (values[: chunk.count] for values in on_host))
        shown = np.flatnonzero(depths != CULLED)
        if at + len(shown) > buffers.rows:
            return np.concatenate([*found, shown]), chunk.base + chunk.count
        # `take`: a sixth of the time of `splats[shown]`.
        backend.write(buffers.records, splats.take(shown, axis=0), 16 * at)
        backend.write(buffers.keys, depths.take(shown), at)
        backend.write(buffers.bounds, counts.take(shown), at)
        found.append((chunk.base + shown).astype(np.uint32))
        at += len(shown)
    return np.concatenate(found) if found else np.zeros(0, np.uint32), scene.count
