"""Draws a small scene from many places, for choosing cameras: which rows each view shows, and how much of them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.candidates import Show
from flexgs_edge.kernels.backend import Backend
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.render.statistics import Statistics
from flexgs_edge.scene.source import MemorySource

NEAR = 1e-3
"""Near plane, in units of the scene's smallest part."""


@contextmanager
def sketch(backend: Backend, budget: MemoryBudget, planes: dict[str, np.ndarray]) -> Iterator[Show]:
    """What shows a small scene ({field: [width, M] f32}) from any camera, while the context lasts."""
    source = MemorySource(planes)
    renderer = Renderer(backend, budget, NEAR)
    with renderer.load(source) as scene:

        def show(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
            statistics = Statistics.zeros(source.count)
            renderer.add_statistics(scene, camera, statistics)
            rows = np.flatnonzero(statistics.weights)
            return rows, statistics.weight_sums[rows]

        yield show
    renderer.release()
