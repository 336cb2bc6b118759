"""The original model's own renders, kept in half precision in a scratch file: targets of refits, and no photos needed."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from flexgs_edge.cameras import Camera
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.renderer import Renderer


class TargetViews:
    """Renders of one scene from some cameras, as `Renderer.residual_sums` wants them.

    Half precision (11 bits) is finer than the 8 bits that any viewer shows. The file is read with plain reads: a mapped file
    would count as memory of the process.

    Parameters
    ----------
    renderer, scene : Renderer, DeviceScene
        The original.
    cameras : sequence of Camera
    scratch : path, optional
        Folder of the scratch file; the system's default otherwise.
    """

    def __init__(
        self,
        renderer: Renderer,
        scene: DeviceScene,
        cameras: Sequence[Camera],
        scratch: str | Path | None = None,
        progress: Progress = SILENT,
    ) -> None:
        self._file = tempfile.TemporaryFile(dir=scratch)  # noqa: SIM115 (closed with the object)
        self._places: list[tuple[int, tuple[int, ...]]] = []
        offset = 0
        try:
            for camera in progress.track(cameras, "rendering the original", len(cameras)):
                planes = renderer.render_planes(scene, camera).astype(np.float16)
                self._file.write(planes.data)
                self._places.append((offset, planes.shape))
                offset += planes.nbytes
        except BaseException:
            self._file.close()
            raise

    def __getitem__(self, view: int) -> np.ndarray:
        """[3, H, W] f16, both sides rounded up to whole tiles."""
        offset, shape = self._places[view]
        planes = np.empty(shape, np.float16)
        self._file.seek(offset)
        self._file.readinto(planes.data.cast("B"))
        return planes

    def close(self) -> None:
        """Remove the scratch file."""
        self._file.close()

    def __enter__(self) -> TargetViews:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()
