"""The renderer that draws the views of a run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.renderer import Renderer


@dataclass
class RenderContext:
    """Draws the views of a run; a context manager that closes the backend."""

    renderer: Renderer  # owns the backend and the budget

    def images(self, scene: DeviceScene, cameras: Sequence[Camera]) -> Iterator[np.ndarray]:
        """Draw each view as `Renderer.render` does, in their order."""
        for camera in self.renderer.in_turn(scene, cameras):
            yield self.renderer.render(scene, camera)

    def close(self) -> None:
        """Close the backend."""
        self.renderer.release()
        self.renderer.backend.close()

    def __enter__(self) -> RenderContext:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()
