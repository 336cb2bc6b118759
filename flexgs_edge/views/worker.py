"""What a worker of the cluster does: hold a scene, draw views of it, and send back sums or pictures."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np

from flexgs_edge._version import __version__
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.constants import TILE
from flexgs_edge.kernels.open_backend import open_backend
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource
from flexgs_edge.views.one_view import Drawn, drawn_sums


@dataclass(frozen=True)
class Drawing:
    """How workers draw, by the words of `Renderer`; `memory_limit` is each one's own."""

    device: str | None
    memory_limit: int | None
    near: float
    background: tuple[float, float, float]
    extent: str
    antialiased: bool


class _Desk:
    """What a worker process keeps from view to view: a renderer, and the scene sent last."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self._renderer: Renderer | None = None
        self._drawing: Drawing | None = None
        self._key = ""
        self._scene: DeviceScene | None = None

    def ready(self, held: tuple[str, MemorySource], drawing: Drawing) -> tuple[Renderer, DeviceScene]:
        """The renderer, and the scene loaded."""
        if self._drawing != drawing or self._renderer is None:
            self._key, self._scene = "", None
            budget = MemoryBudget.from_limit(drawing.memory_limit)
            backend = open_backend(drawing.device, budget)
            self._renderer = Renderer(
                backend, budget, drawing.near, drawing.background, drawing.extent, drawing.antialiased
            )
            self._drawing = drawing
        key, source = held
        if key != self._key or self._scene is None:
            if self._scene is not None:
                self._scene.close()
            self._key, self._scene = key, self._renderer.load(source)
        return self._renderer, self._scene


_DESK = _Desk()


def draw_planes(held: tuple[str, MemorySource], drawing: Drawing, camera: Camera) -> np.ndarray:
    """A view, as `Renderer.render_planes` gives it."""
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
    """The sums of a view: see `drawn_sums`."""
    with _DESK.lock:
        renderer, scene = _DESK.ready(held, drawing)
        return drawn_sums(renderer, scene, kind, camera, target, picture)


def warm_up(drawing: Drawing) -> None:
    """Draw one Gaussian as views will be: a worker's first view is slow, since its kernels are loaded then."""
    planes = {name: np.zeros((field.width(0), 1), np.float32) for name, field in FIELD.items()}
    planes["quats"][0] = 1
    camera = Camera("", TILE, TILE, np.eye(3), np.array([0.0, 0.0, 1.0]), TILE, TILE, TILE / 2, TILE / 2)
    target = np.zeros((3, TILE, TILE), np.float16)
    held = "", MemorySource(planes)
    draw_sums(held, drawing, "removal_sums", camera, None, picture=True)
    draw_sums(held, drawing, "residual_and_removal_sums", camera, target, picture=False)


def worker_version() -> str:
    """The version of this program that a worker runs."""
    return __version__
