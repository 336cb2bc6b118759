"""The original model's own renders, kept in half precision in a scratch file: targets of refits, and no photos needed."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.renderer import Renderer

HALF_LARGEST = float(np.finfo(np.float16).max)


def to_half(values: np.ndarray) -> np.ndarray:
    """Half precision, at the ends of its range where a value lies beyond: infinity would become NaN in every sum."""
    half: np.ndarray = np.clip(values, -HALF_LARGEST, HALF_LARGEST).astype(np.float16)
    return half


class References:
    """Renders of one scene from some cameras, as `Renderer.residual_sums` wants them.

    Half precision (11 bits) is finer than the 8 bits that any viewer shows. The file is read with plain reads: a mapped file
    would count as memory of the process.

    Parameters
    ----------
    scratch : path, optional
        Folder of the scratch file; the system's default otherwise.
    """

    def __init__(self, scratch: str | Path | None = None) -> None:
        self._file = tempfile.TemporaryFile(dir=scratch)  # noqa: SIM115 (closed with the object)
        self._places: dict[int, tuple[int, tuple[int, ...]]] = {}
        self._end = 0

    @classmethod
    def of(
        cls,
        renderer: Renderer,
        scene: DeviceScene,
        cameras: Sequence[Camera],
        scratch: str | Path | None = None,
        progress: Progress = SILENT,
    ) -> References:
        """All views of `scene` from `cameras`."""
        views = cls(scratch)
        try:
            for view, camera in enumerate(
                progress.track(renderer.in_turn(scene, cameras), "rendering the original", len(cameras))
            ):
                views.add(view, renderer.render_planes(scene, camera))
        except BaseException:
            views.close()
            raise
        return views

    def add(self, view: int, planes: np.ndarray) -> None:
        """Keep a view ([3, H, W] f32, as `Renderer.render_planes` gives it, or f16)."""
        half = to_half(planes)
        self._file.seek(self._end)
        self._file.write(half.data)
        self._places[view] = (self._end, half.shape)
        self._end += half.nbytes

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

    def __enter__(self) -> References:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()
