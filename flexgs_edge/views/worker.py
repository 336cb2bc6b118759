"""A worker of the cluster: it holds a scene, draws views of it, and sends back sums or pictures."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np

from flexgs_edge._version import __version__
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.kernels.open_backend import open_backend
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.source import MemorySource
from flexgs_edge.views.one_view import Drawn, drawn_sums


@dataclass(frozen=True)
class Drawing:
    """Settings of a worker's `Renderer`; `memory_limit` (bytes) holds for each worker."""

    device: str | None
    memory_limit: int | None
    near: float
    background: tuple[float, float, float]
    antialiased: bool


class _Desk:
    """State of a worker process between views: a renderer, and the last scene that was sent."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self._renderer: Renderer | None = None
        self._drawing: Drawing | None = None
        self._key = ""
        self._scene: DeviceScene | None = None

    def ready(self, held: tuple[str, MemorySource], drawing: Drawing) -> tuple[Renderer, DeviceScene]:
        """The renderer and the loaded scene; both are reused until `drawing` or the scene changes."""
        if self._drawing != drawing or self._renderer is None:
            self._key, self._scene = "", None
            budget = MemoryBudget.from_limit(drawing.memory_limit)
            backend = open_backend(drawing.device, budget)
            self._renderer = Renderer(backend, budget, drawing.near, drawing.background, drawing.antialiased)
            self._drawing = drawing
        key, source = held
        if key != self._key or self._scene is None:
            if self._scene is not None:
                self._scene.close()
            self._key, self._scene = key, self._renderer.load(source)
        return self._renderer, self._scene


_DESK = _Desk()


def draw_planes(held: tuple[str, MemorySource], drawing: Drawing, camera: Camera) -> np.ndarray:
    """Draw a view in the layout of `Renderer.render_planes`."""
    with _DESK.lock:
        renderer, scene = _DESK.ready(held, drawing)
        return renderer.render_planes(scene, camera)


def draw_sums(
    held: tuple[str, MemorySource],
    drawing: Drawing,
    kind: str,
    camera: Camera,
    target: np.ndarray | None,
    picture: bool,
) -> Drawn:
    """Draw the sums of a view; see `drawn_sums`."""
    with _DESK.lock:
        renderer, scene = _DESK.ready(held, drawing)
        return drawn_sums(renderer, scene, kind, camera, target, picture)


def worker_version() -> str:
    """The version of this program that a worker runs."""
    return __version__
