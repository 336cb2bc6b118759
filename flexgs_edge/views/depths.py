"""Distance of each camera to what it looks at, by the scene's Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.render.statistics import Statistics
from flexgs_edge.scene.lower_sh import without_degrees
from flexgs_edge.scene.source import SceneSource
from flexgs_edge.small_matrices import product

MIDDLE = 3  # A camera looks at the middle one of so many parts of its frame, across and down


def middle_of(camera: Camera) -> Camera:
    """The middle part of a camera's frame, as a camera of its own with the same pixels."""
    left, top = (pixels // 2 - pixels // (2 * MIDDLE) for pixels in (camera.width, camera.height))
    return replace(
        camera,
        width=max(camera.width // MIDDLE, 1),
        height=max(camera.height // MIDDLE, 1),
        cx=camera.cx - left,
        cy=camera.cy - top,
    )


def visible_depths(renderer: Renderer, source: SceneSource, cameras: Sequence[Camera]) -> list[float]:
    """Distance of each camera to what it looks at: the median depth of the light in the middle of its frame.

    A camera that sees nothing there gets the median of the others. If no camera sees anything, all get 1.

    Returns scene units, one for each camera.
    """
    means = source.read(slice(0, source.count), ["means"])["means"]
    depths = []
    with renderer.load(without_degrees(source, 0)) as scene:
        for camera in map(middle_of, cameras):
            statistics = Statistics.zeros(source.count)
            renderer.add_statistics(scene, camera, statistics)
            rows = np.flatnonzero(statistics.weights)
            moved = camera.moved(source.origin)
            depth = product(moved.rotation[2:], means[:, rows].astype(np.float64))[0] + moved.translation[2]
            order = np.argsort(depth, kind="stable")
            light = np.cumsum(statistics.weights[rows][order])
            depths.append(float(depth[order[np.searchsorted(light, light[-1] // 2)]]) if len(rows) else np.nan)
    renderer.release()
    known = [depth for depth in depths if depth == depth]
    usual = float(np.median(known)) if known else 1.0
    return [depth if depth == depth else usual for depth in depths]
