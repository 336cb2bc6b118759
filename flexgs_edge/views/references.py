"""Renders of the original model, the targets of fine-tuning in place of photos: a scratch file holds them in half precision."""

import tempfile
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.renderer import Renderer

HALF_LARGEST = float(np.finfo(np.float16).max)


def to_half(values: np.ndarray) -> np.ndarray:
    """Round to half precision, clipped to its range: an infinity would become NaN in every sum."""
    return np.clip(values, -HALF_LARGEST, HALF_LARGEST).astype(np.float16)


class References(AbstractContextManager["References"]):
    """Renders of one scene from some cameras, in the layout that `Renderer.residual_sums` takes.

    Half precision (11 bits) is finer than the 8 bits that viewers show. We read the file with plain reads, since the
    pages of a mapped file would count as memory of the process.

    `scratch`: folder of the scratch file; by default the system's folder for temporary files.
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
    ) -> "References":
        """Render `scene` from each camera and keep the views."""
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

    def make_room(self, view: int, count: int) -> None:
        """Give each view from number `view` on a number that is `count` higher."""
        self._places = {place + count * (place >= view): found for place, found in self._places.items()}

    def __getitem__(self, view: int) -> np.ndarray:
        """[3, H, W] f16, a kept view; both sides are rounded up to whole tiles."""
        offset, shape = self._places[view]
        planes = np.empty(shape, np.float16)
        self._file.seek(offset)
        self._file.readinto(planes.data.cast("B"))
        return planes

    def close(self) -> None:
        """Remove the scratch file."""
        self._file.close()

    def __exit__(self, *exc: object) -> None:
        self.close()


@dataclass(frozen=True)
class Original:
    """The original from some poses."""

    renderer: Renderer  # draws the views
    origin: np.ndarray  # [3] f64, as in `SceneSource`
    cameras: Sequence[Camera]  # scored poses
    references: References  # renders of the original from `cameras`, then from `between`
    # Further poses, if there are descents. One that knew only the scored poses would fit these, and get worse between them.
    between: Sequence[Camera] = ()
    progress: Progress = SILENT  # told of each view
    steps: int = 0  # steps of the descent to the first candidate; 0 (default): colours are refitted instead
    # [n] f64, above 0: how often a descent looks at each of `poses`, relative to the others. Default: alike.
    turns: np.ndarray | None = None
    depth: float = 1.0  # usual distance of the poses to what they look at, scene units: positions move by a share of it

    @property
    def poses(self) -> list[Camera]:
        """All poses, in the order of their references."""
        return [*self.cameras, *self.between]
