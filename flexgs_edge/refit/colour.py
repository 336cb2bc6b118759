"""Colour refit in closed form: SIRT rounds that back-project the residual against the original's own renders."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from flexgs_edge.cameras import Camera
from flexgs_edge.constants import SH_C0
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.render import DeviceScene, Renderer
from flexgs_edge.render.targets import TargetViews
from flexgs_edge.scene.fields import sh_rest_count
from flexgs_edge.scene.source import MemorySource

RELAX_DC = 1.0
RELAX_SH = 0.3
"""Step of a round, as a share of the SIRT step of the constant alone. With all bands moving at once, a pixel's row sum is
about 1 + 15 mean |Y_k| / Y_0 of the constant's, hence the smaller step for the bands."""


def refit_colours(
    renderer: Renderer,
    planes: dict[str, np.ndarray],
    degrees: np.ndarray,
    origin: np.ndarray,
    cameras: Sequence[Camera],
    targets: TargetViews,
    rounds: int,
    bands: bool = True,
    progress: Progress = SILENT,
) -> dict[str, np.ndarray]:
    """Move colours towards the original's renders, all at once, for a fixed number of rounds.

    Each round adds to every coefficient `relax * sum(Y alpha T r) / sum(|Y| alpha T)` over pixels and poses, with r the
    original's render minus the present one (SIRT: Gilbert 1972). Gaussians that no pose sees stay as they are.

    Parameters
    ----------
    planes : dict
        Stored planes of the kept Gaussians ([width, n] f32 by field); not changed.
    degrees : np.ndarray
        [n] SH degree kept for each row: coefficients above it stay zero.
    origin : np.ndarray
        [3] f64, as in `SceneSource`.
    targets : TargetViews
        The original from `cameras`.
    bands : bool
        Refit the SH above degree 0 as well (otherwise the constant only).

    Returns
    -------
    dict
        The planes, with new `sh_dc` and `sh_rest`.
    """
    planes = {**planes, "sh_dc": planes["sh_dc"].copy(), "sh_rest": planes["sh_rest"].copy()}
    source = MemorySource(planes, origin=origin)
    with renderer.load(source) as scene:
        for _ in progress.track(range(rounds), "refitting colours", rounds):
            normal = _normal_sums(renderer, scene, cameras, targets)
            _step(planes, degrees, normal, bands)
            scene.refresh("sh_dc", "sh_rest")
    return planes


def _normal_sums(renderer: Renderer, scene: DeviceScene, cameras: Sequence[Camera], targets: TargetViews) -> np.ndarray:
    """[K + 1, 4, n] f32: for every basis function the back-projected residual of three channels and the weight."""
    backend = renderer.backend
    arrays: dict[int, tuple[int, Any]] = {}
    try:
        for view, camera in enumerate(cameras):
            sums = renderer.residual_sums(scene, camera, targets[view])
            for chunk in scene.chunks():
                if chunk.base not in arrays:
                    array = backend.array(((chunk.degree + 1) ** 2, 4, chunk.stride), np.float32)
                    backend.fill(array, 0)
                    arrays[chunk.base] = (chunk.count, array)
                backend.launch(
                    "sh_residual", (chunk.stride,), chunk.count, chunk.stride, chunk.base, chunk.degree, sums.shape[2],
                    renderer.camera_array, chunk.means, sums, arrays[chunk.base][1],
                )  # fmt: skip
        normal = np.zeros(((scene.sh_degree + 1) ** 2, 4, scene.count), np.float32)
        for base, (count, array) in arrays.items():
            sums_of_chunk = backend.read(array)[:, :, :count]
            normal[: len(sums_of_chunk), :, base : base + count] = sums_of_chunk
    finally:
        for _, array in arrays.values():
            array.release()
    return normal


def _step(planes: dict[str, np.ndarray], degrees: np.ndarray, normal: np.ndarray, bands: bool) -> None:
    weight = np.where(normal[:, 3] > 0, normal[:, 3], np.float32(np.inf))
    # The constant's basis is Y_0 everywhere: its step in coefficients is 1 / Y_0 of the mean residual.
    planes["sh_dc"] += np.float32(RELAX_DC / SH_C0) * normal[0, :3] / weight[0]
    if not bands or len(normal) == 1:
        return
    count = len(normal) - 1
    degree_of = np.repeat(np.arange(1, 5), [sh_rest_count(d) - sh_rest_count(d - 1) for d in range(1, 5)])[:count]
    rest = planes["sh_rest"].reshape(3, count, -1)
    for k in range(count):
        moved = np.where(degrees >= degree_of[k], np.float32(RELAX_SH) / weight[k + 1], np.float32(0))
        rest[:, k] += normal[k + 1, :3] * moved
