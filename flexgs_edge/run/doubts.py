"""What a run has to say about how far its figures can be trusted: sentences with a number each, or nothing."""

from __future__ import annotations

from collections.abc import Sequence

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.goals.steps import Scored
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.quality.psnr import mean_psnr, mse, psnr
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.run.options import AUTO_CAMERAS
from flexgs_edge.run.view_set import ViewSet
from flexgs_edge.views.references import References

FIT_VIEWS = 8
"""Training poses that the finished file is compared on, evenly spread."""
FIT_STEP = 2
"""Pixels of them from one to the next, in both directions."""
FIT_GAP = 2.0
"""Fidelity on training poses above that on held-out views, dB, from which a choice counts as fitted to what was scored."""
NEEDED_VIEWS = 16
"""Scored poses from which more change little: docs/results/speed.md#scoring-fewer-views"""
UNSEEN_SHARE = 0.01
"""Share of the Gaussians in none of the automatic views that is worth a word."""


class TrainingPoses:
    """Some training poses that a finished file is compared on, beside the views that report.

    Parameters
    ----------
    renderer : Renderer
    original : DeviceScene
        Drawn from them at once.
    cameras : sequence of Camera
        All training poses.
    """

    def __init__(
        self, renderer: Renderer, original: DeviceScene, cameras: Sequence[Camera], progress: Progress = SILENT
    ) -> None:
        count = min(FIT_VIEWS, len(cameras))
        self._renderer = renderer
        self._cameras = [cameras[i * len(cameras) // count].every(FIT_STEP) for i in range(count)]
        self._references = References.of(renderer, original, self._cameras, progress=progress)

    def fidelity(self, scene: DeviceScene) -> float | None:
        """Fidelity of `scene`, mean over the poses; `None` when all are identical."""
        found = []
        for view, camera in enumerate(self._renderer.in_turn(scene, self._cameras)):
            inside = (slice(None), slice(camera.height), slice(camera.width))
            planes = self._renderer.render_planes(scene, camera)
            found.append(psnr(mse(planes[inside], self._references[view][inside])))
        return mean_psnr(found)

    def close(self) -> None:
        """Remove what the original looked like."""
        self._references.close()


def doubts(
    views: ViewSet, scored: Scored | None, count: int, trained: float | None, held_out: float | None
) -> tuple[str, ...]:
    """Warnings of a run.

    Parameters
    ----------
    scored : Scored or None
        What the search was told by.
    count : int
        Gaussians of the scene.
    trained, held_out : float or None
        Fidelity on training poses and on held-out views, dB.
    """
    found = []
    if trained is not None and held_out is not None and trained - held_out > FIT_GAP:
        found.append(
            f"fidelity is {trained:.1f} dB on training poses and {held_out:.1f} dB on held-out views, {trained - held_out:.1f} "
            "dB less: the choice fits what was scored, and views from elsewhere may look worse; score more poses "
            "(--effort thorough, more cameras) or try --views-margin"
        )
    if scored is not None and scored.poses < NEEDED_VIEWS:
        found.append(
            f"{scored.poses} poses were scored, and ranks settle from about {NEEDED_VIEWS}: the loss away from them is not known "
            "well; give more cameras, or --views-margin, which makes some"
        )
    if scored is not None and views.cameras_from == AUTO_CAMERAS and scored.unseen > UNSEEN_SHARE * count:
        found.append(
            f"{scored.unseen} of {count} Gaussians ({100 * scored.unseen / count:.1f} %) are in none of the {scored.poses} "
            "automatic views that were scored: what they show was not judged; give the scene's cameras (--cameras PATH), and see "
            "--unseen"
        )
    return tuple(found)
