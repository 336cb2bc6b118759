"""The original from a few poses that decide no target: how well a finished scene does there."""

from __future__ import annotations

from collections.abc import Sequence

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.generated import FARTHER, NEARER, at_distance
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.quality.psnr import mse
from flexgs_edge.quality.view_quality import Quality, ViewQuality
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.source import SceneSource
from flexgs_edge.views.depths import visible_depths
from flexgs_edge.views.references import References

STEP = 2  # Every second pixel in both directions is read
MOST = 8  # At most so many training poses, evenly spread, tell whether a result fits the scored poses too closely
MADE_FROM = 6  # At most so many of the views that decide, evenly spread, get a nearer and a farther pose each


class FewPoses:
    """Renders of the original from a few poses, and the fidelity of other scenes there."""

    def __init__(
        self,
        renderer: Renderer,  # draws both scenes
        original: DeviceScene,  # the loaded original; the constructor draws its references
        cameras: Sequence[Camera],  # the poses, at full resolution
        covered_decides: bool,  # as for `Quality`: fidelity is over covered pixels
        progress: Progress = SILENT,  # shows a bar while the references are drawn
    ) -> None:
        self._renderer = renderer
        self._cameras = [camera.every(STEP) for camera in cameras]
        self._covered_decides = covered_decides
        self._coverage: list[float] = []
        self._references = References()
        in_turn = renderer.in_turn(original, self._cameras)
        try:
            for view, camera in enumerate(progress.track(in_turn, "rendering the original", len(cameras))):
                self._references.add(view, renderer.render_planes(original, camera))
                self._coverage.append(renderer.drawn_coverage())
        except BaseException:
            self.close()
            raise

    def quality(self, scene: DeviceScene) -> Quality:
        """Errors of `scene` against the original from these poses."""
        found = []
        for view, camera in enumerate(self._renderer.in_turn(scene, self._cameras)):
            inside = (slice(None), slice(camera.height), slice(camera.width))
            planes = self._renderer.render_planes(scene, camera)
            error = mse(planes[inside], self._references[view][inside])
            found.append(ViewQuality(camera.name, error, coverage=self._coverage[view]))
        return Quality(tuple(found), covered_decides=self._covered_decides)

    def close(self) -> None:
        """Free the renders of the original."""
        self._references.close()


def evenly(cameras: Sequence[Camera], most: int) -> list[Camera]:
    """At most `most` of the cameras, evenly spread."""
    count = min(most, len(cameras))
    return [cameras[i * len(cameras) // count] for i in range(count)]


def made_poses(renderer: Renderer, source: SceneSource, cameras: Sequence[Camera]) -> list[Camera]:
    """A nearer and a farther pose for each of some of the views that decide."""
    some = evenly(cameras, MADE_FROM)
    depths = visible_depths(renderer, source, some)
    return [
        at_distance(camera, depth, times)
        for camera, depth in zip(some, depths, strict=True)
        for times in (NEARER, FARTHER)
    ]
