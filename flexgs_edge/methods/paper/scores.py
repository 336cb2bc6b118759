"""Scores Gaussians from hits and weights over the training poses, as FlexGaussian (`gs`) or MesonGS (`meson`) does."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.constants import VOLUME_POWER
from flexgs_edge.errors import InputError
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.render.statistics import Statistics
from flexgs_edge.scene.source import SceneSource

SCORES = ("gs", "meson")
ROWS = 1 << 16  # Rows of the scene read at a time
SCORE_ROW_BYTES = 28  # Bytes a Gaussian that scoring holds: hits and weights, and what one view adds to them


def score_scene(
    renderer: Renderer,  # draws the views
    scene: DeviceScene,  # loaded from `source`
    source: SceneSource,  # read again for opacities and volumes, `ROWS` rows at a time
    cameras: Sequence[Camera],  # the training poses
    kind: str = "gs",
    progress: Progress = SILENT,  # told of each view
) -> np.ndarray:
    """Log of the importance of every Gaussian. Only the order matters, and a log cannot underflow for tiny volumes.

    `kind` ({"gs", "meson"}): `gs`: opacity * volume^0.1 * hits (LightGaussian, FlexGaussian). `meson`: volume^0.1 *
    sum(alpha T) (MesonGS). Default: `gs`. Returns [N] f64; -inf for Gaussians that no pose sees. Raises `InputError`
    for an unknown kind, or when no camera sees any Gaussian.
    """
    if kind not in SCORES:
        raise InputError(f"score {kind!r}: expected one of {', '.join(SCORES)}")
    statistics = gather_statistics(renderer, scene, cameras, progress)
    scores = np.empty(source.count)
    for rows in source.chunks(ROWS):
        part = source.read(rows, ["log_scales", "opacity_logits"])
        seen = Statistics(statistics.hits[rows], statistics.weights[rows])
        scores[rows] = VOLUME_POWER * part["log_scales"].sum(axis=0, dtype=np.float64)
        if kind == "gs":
            scores[rows] -= np.logaddexp(0.0, -part["opacity_logits"][0].astype(np.float64))
        with np.errstate(divide="ignore"):  # unseen Gaussians get log(0) = -inf
            scores[rows] += np.log(seen.hits.astype(np.float64) if kind == "gs" else seen.weight_sums)
    return scores


def gather_statistics(
    renderer: Renderer, scene: DeviceScene, cameras: Sequence[Camera], progress: Progress = SILENT
) -> Statistics:
    """Hits and weights of every Gaussian over `cameras`. Sums are exact, so any order of views gives the same bits."""
    statistics = Statistics.zeros(scene.count)
    for camera in progress.track(cameras, "scoring views", len(cameras)):
        renderer.add_statistics(scene, camera, statistics)
    if not statistics.hits.any():
        raise InputError(
            f"none of the {len(cameras)} cameras sees any of the {scene.count} Gaussians: do scene and cameras belong together, "
            "and is the near plane (--near) in front of the scene?"
        )
    return statistics
