"""The renderer and the optional cluster that draw the views of a run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.views.cluster import Cluster


@dataclass
class RenderContext:
    """Draws the views of a run; a context manager that closes the cluster and the backend."""

    renderer: Renderer  # owns the backend and the budget
    cluster: Cluster | None = None  # draws the views of `ViewSums.draw` and `images` in the renderer's stead

    def images(self, scene: DeviceScene, cameras: Sequence[Camera]) -> Iterator[np.ndarray]:
        """Draw each view as `Renderer.render` does, in their order, here or on the cluster."""
        renderer, cluster = self.renderer, self.cluster
        if cluster is None or scene.source is None:
            for camera in renderer.in_turn(scene, cameras):
                yield renderer.render(scene, camera)
            return
        for camera, planes in zip(cameras, cluster.planes(scene.source, cameras), strict=True):
            yield planes[:, : camera.height, : camera.width].transpose(1, 2, 0)

    def close(self) -> None:
        """Leave the cluster, and close the backend."""
        if self.cluster is not None:
            self.cluster.close()
        self.renderer.release()
        self.renderer.backend.close()

    def __enter__(self) -> RenderContext:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()
