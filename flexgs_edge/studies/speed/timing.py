"""Times views: whole passes, and the stages of a view."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.renderer import Renderer

STAGES = {
    "projection": ("project",),
    "sort": ("sort_count_first", "sort_scatter_first", "sort_count", "sort_scatter", "exclusive_scan"),
    "tile lists": ("tile_room", "tile_count", "tile_scatter"),
    "blend": ("blend",),
}
"""Kernels of each stage of a view. The short scans of the tile lists count as sorting."""


def draw_seconds(renderer: Renderer, scene: DeviceScene, cameras: Sequence[Camera]) -> float:
    """Seconds to draw all views once. The scene is loaded and buffers are made before."""
    renderer.render(scene, cameras[0])
    started = time.perf_counter()
    for camera in cameras:
        renderer.render(scene, camera)
    return time.perf_counter() - started


def stage_seconds(renderer: Renderer, scene: DeviceScene, cameras: Sequence[Camera]) -> dict[str, float]:
    """Seconds of each of `STAGES` over all views. Every kernel is waited for, so the sum exceeds `draw_seconds`."""
    renderer.render(scene, cameras[0])
    backend = renderer.backend
    backend.profile = defaultdict(float)
    try:
        for camera in cameras:
            renderer.render(scene, camera)
        return {stage: sum(backend.profile[name] for name in kernels) for stage, kernels in STAGES.items()}
    finally:
        backend.profile = None


def median(values: Sequence[float]) -> float:
    """The median of at least one number."""
    return float(np.median(np.asarray(values)))
