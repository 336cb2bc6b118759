"""Scores Gaussians from hits and weights over the training poses, as FlexGaussian (`gs`) or MesonGS (`meson`) does."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.constants import VOLUME_POWER
from flexgs_edge.errors import InputError
from flexgs_edge.files import atomic_write
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.render.statistics import Statistics
from flexgs_edge.run.fingerprint import fingerprint
from flexgs_edge.run.run import Run
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


class ScoreCache:
    """A file with the scores of one scene seen from one set of poses.

    `path`: made by `save`. It need not exist. `fingerprint`: of the scene, poses and kind of score.
    """

    def __init__(self, path: str | Path, fingerprint: str) -> None:
        self.path, self.fingerprint = Path(path), fingerprint

    def load(self, count: int) -> np.ndarray | None:
        """[count] f64, or `None` if there is no file yet or its fingerprint differs.

        Raises `InputError` when `save` did not write the file, because the run would overwrite it.
        """
        try:
            with open(self.path, "rb") as file, np.load(file, allow_pickle=False) as archive:
                key, scores = str(archive["fingerprint"]), archive["scores"]
        except FileNotFoundError:
            return None
        except (OSError, ValueError, EOFError, KeyError, TypeError, zipfile.BadZipFile, zlib.error) as error:
            raise InputError(
                f"{self.path}: expected scores kept by score or by an earlier --score-cache, found something else ({error}); "
                "remove the file, or name another one"
            ) from error
        same = key == self.fingerprint and scores.shape == (count,) and scores.dtype == np.float64
        return scores if same else None

    def save(self, scores: np.ndarray) -> None:
        """Write the scores ([N] f64); an old file is replaced."""
        with atomic_write(self.path, force=True) as file:
            np.savez(file, fingerprint=np.array(self.fingerprint), scores=scores)


def score_cache(path: str | Path, run: Run[Any], score: str) -> ScoreCache:
    """The cache at `path`, with the fingerprint of a run and the kind of its scores."""
    options = run.options
    assert options.near is not None
    cameras = run.seen.of(run.seen.train)
    return ScoreCache(path, fingerprint(run.source, cameras, score, options.near, bool(options.antialiased)))
