"""Colour refit in closed form: SIRT rounds that back-project the residual against the original's own renders."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from flexgs_edge.cameras import Camera
from flexgs_edge.constants import SH_C0
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.render import DeviceScene, Renderer, sum_bytes
from flexgs_edge.render.targets import TargetViews
from flexgs_edge.scene.fields import sh_rest_count
from flexgs_edge.scene.source import MemorySource

RELAX_DC = 1.0
RELAX_SH = 0.25
"""Step of a round, as a share of the SIRT step of the constant alone. With all bands moving at once, a pixel seen by one pose
moves by its residual times 1 + 15 mean |Y_k| * this, which must stay below 2 or steps after few poses grow: at 0.6 a second
refit of fox at 0.1 dB, where nearly all Gaussians keep their SH, went from a drop of 0.11 to 2.5 dB. At 1 dB both end at the
same bytes."""


def refit_colours(
    renderer: Renderer,
    planes: dict[str, np.ndarray],
    degrees: np.ndarray,
    origin: np.ndarray,
    cameras: Sequence[Camera],
    targets: TargetViews,
    rounds: int,
    bands: bool = True,
    subsets: int = 1,
    progress: Progress = SILENT,
) -> dict[str, np.ndarray]:
    """Move colours towards the original's renders, all at once, for a fixed number of rounds.

    Each step adds to every coefficient `relax * sum(Y alpha T r) / sum(|Y| alpha T)` over pixels and poses, with r the
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
    rounds : int
        Times that every pose is looked at.
    bands : bool
        Refit the SH above degree 0 as well (otherwise the constant only).
    subsets : int
        Steps a round, each after an interleaved part of the poses (ordered subsets: Hudson & Larkin 1994).

    Returns
    -------
    dict
        The planes, with new `sh_dc` and `sh_rest`.
    """
    planes = {**planes, "sh_dc": planes["sh_dc"].copy(), "sh_rest": planes["sh_rest"].copy()}
    subsets = max(min(subsets, len(cameras)), 1)
    parts = [range(first, len(cameras), subsets) for _ in range(rounds) for first in range(subsets)]
    source = MemorySource(planes, origin=origin)
    room = sum_bytes(4) + normal_bytes(source.sh_degree)
    with renderer.load(source, room, targets=True) as scene:
        for part in progress.track(parts, "refitting colours", len(parts)):
            normal = NormalSums(renderer, scene)
            try:
                for view in part:
                    normal.add_view(renderer.residual_sums(scene, cameras[view], targets[view]))
                step_colours(planes, degrees, normal.finish(), bands)
            finally:
                normal.release()
            scene.refresh("sh_dc", "sh_rest")
    return planes


def normal_bytes(sh_degree: int) -> int:
    """Bytes a row that `NormalSums` takes on the backend."""
    return 16 * (sh_degree + 1) ** 2


class NormalSums:
    """Sums over views that a step of the refit is made of: back-projected residuals and weights, for every basis function."""

    def __init__(self, renderer: Renderer, scene: DeviceScene) -> None:
        self._renderer, self._scene = renderer, scene
        self._arrays: dict[int, tuple[int, Any]] = {}

    def add_view(self, sums: Any) -> None:
        """Add the view drawn last; its residual sums come first in `sums`. The order of views is part of the result."""
        backend = self._renderer.backend
        for chunk in self._scene.chunks():
            if chunk.base not in self._arrays:
                array = backend.array(((chunk.degree + 1) ** 2, 4, chunk.stride), np.float32)
                backend.fill(array, 0)
                self._arrays[chunk.base] = (chunk.count, array)
            backend.launch(
                "sh_residual", (chunk.stride,), chunk.count, chunk.stride, chunk.base, chunk.degree, sums.shape[1],
                self._renderer.camera_array, chunk.means, sums, self._arrays[chunk.base][1],
            )  # fmt: skip

    def finish(self) -> np.ndarray:
        """[K + 1, 4, n] f32: residual of three channels and weight."""
        normal = np.zeros(((self._scene.sh_degree + 1) ** 2, 4, self._scene.count), np.float32)
        for base, (count, array) in self._arrays.items():
            sums_of_chunk = self._renderer.backend.read(array)[:, :, :count]
            normal[: len(sums_of_chunk), :, base : base + count] = sums_of_chunk
        return normal

    def release(self) -> None:
        """Free what is held on the backend."""
        for _, array in self._arrays.values():
            array.release()
        self._arrays = {}


def step_colours(planes: dict[str, np.ndarray], degrees: np.ndarray, normal: np.ndarray, bands: bool = True) -> None:
    """One step, in place: `normal` from `NormalSums.finish`, the rest as for `refit_colours`."""
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
