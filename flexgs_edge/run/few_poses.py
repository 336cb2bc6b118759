"""The original from a few poses that decide no target: how well a finished scene does there, and poses made for that."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.generated import FARTHER, NEARER, at_distance
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.quality.psnr import mse
from flexgs_edge.quality.view_quality import Quality, ViewQuality
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.source import SceneSource, without_degrees
from flexgs_edge.small_matrices import product
from flexgs_edge.views.references import References

STEP = 2  # Every second pixel in both directions is read
MOST = 8  # At most so many training poses, evenly spread, tell whether a result fits the scored poses too closely
MADE_FROM = 6  # At most so many of the views that decide, evenly spread, get a nearer and a farther pose each
MIDDLE = 3  # A camera looks at the middle one of so many parts of its frame, across and down
TELLING = 32  # Most cameras that tell what is usual


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


def usual_depth(renderer: Renderer, source: SceneSource, cameras: Sequence[Camera]) -> float:
    """Median of `visible_depths`, scene units. The extent of the cameras says little of it: some stand near, some far."""
    return float(np.median(visible_depths(renderer, source, cameras[:: -(-len(cameras) // TELLING)])))


def middle_of(camera: Camera) -> Camera:
    """The middle part of a camera's frame, as a camera of its own with the same pixels."""
    left, top = (pixels // 2 - pixels // (2 * MIDDLE) for pixels in (camera.width, camera.height))
    return replace(
        camera,
        width=max(camera.width // MIDDLE, 1),
        height=max(camera.height // MIDDLE, 1),
        cx=camera.cx - left,
        cy=camera.cy - top,
    )


def visible_depths(renderer: Renderer, source: SceneSource, cameras: Sequence[Camera]) -> list[float]:
    """Distance of each camera to what it looks at: the median depth of the light in the middle of its frame.

    A camera that sees nothing there gets the median of the others. If no camera sees anything, all get 1.

    Returns scene units, one for each camera.
    """
    means = source.read(slice(0, source.count), ["means"])["means"]
    depths = []
    with renderer.load(without_degrees(source, 0)) as scene:
        for camera in map(middle_of, cameras):
            rows, weights = renderer.shown_weights(scene, camera)
            moved = camera.moved(source.origin)
            depth = product(moved.rotation[2:], means.take(rows, axis=1).astype(np.float64))[0] + moved.translation[2]
            order = np.argsort(depth, kind="stable")
            light = np.cumsum(weights[order])
            depths.append(float(depth[order[np.searchsorted(light, light[-1] // 2)]]) if len(rows) else np.nan)
    renderer.release()
    known = [depth for depth in depths if depth == depth]
    usual = float(np.median(known)) if known else 1.0
    return [depth if depth == depth else usual for depth in depths]
