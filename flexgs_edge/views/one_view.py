"""The sums of one view, split into parts that a scratch file can take."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.render.device_scene import DeviceScene
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
