"""Refits colours to renders of the original, in closed form, without photos.

Each round back-projects the residual images to the Gaussians' colours (SIRT). Geometry stays as it is.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

from flexgs_edge.constants import SH_C0, SUM_LANES
from flexgs_edge.memory.rows import copy_rows, put_rows, read_rows
from flexgs_edge.render.chunks import Chunk, ViewPart
from flexgs_edge.render.fit import padded, sum_bytes
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.render.statistics import planes_of
from flexgs_edge.scene.fields import sh_rest_count
from flexgs_edge.scene.source import MemorySource
from flexgs_edge.views.references import Original
from flexgs_edge.views.sums import Maker, ViewSums

ROUND_VIEWS = 96  # Least poses of a round: docs/results/tuning.md#round_views
RELAX_SH = 0.25
"""Steps of SH, as shares of the SIRT step of the constant alone. All bands move at once. So a pixel seen
by one pose moves by its residual times 1 + 15 mean |Y_k| * RELAX_SH. That factor must stay below 2, or steps from few poses
diverge: docs/results/tuning.md#relax_sh"""


def refit_colours(
    planes: dict[str, np.ndarray],  # stored planes of the kept Gaussians ([width, n] f32 by field); not changed
    degrees: np.ndarray,  # [n] u8, SH degree kept for each row. Coefficients above it stay zero.
    original: Original,  # the scored poses and the original's renders
    rounds: int,
    bands: bool = True,  # Refit the SH above degree 0 too (default). Otherwise only the constant moves.
    subsets: int = 1,
) -> dict[str, np.ndarray]:
    """Move colours towards the original's renders, all at once, for a fixed number of rounds.

    Each step adds `relax * sum(Y alpha T r) / sum(|Y| alpha T)` to every coefficient (SIRT: Gilbert 1972). Sums are over
    pixels and poses, and r is the original's render minus the present one. Gaussians that no pose sees stay as they are.

    `rounds`: how often we look at every pose. Each round takes about as long as rendering all poses. With many poses,
    each round looks at an interleaved set of them: as many sets as have `ROUND_VIEWS` each. `subsets`: steps of a
    round, each from an interleaved part of the poses (ordered subsets: Hudson & Larkin 1994). Default: 1. Returns the
    planes, with new arrays of what has moved.
    """
    renderer, cameras = original.renderer, original.cameras
    storage = renderer.storage
    fields = ("sh_dc", "sh_rest") if bands else ("sh_dc",)
    planes = {**planes, **{name: storage.copy(planes[name]) for name in fields}}
    thinned = max(len(cameras) // ROUND_VIEWS, 1)
    parts = []
    for turn in range(rounds):
        seen = range(turn % thinned, len(cameras), thinned)
        steps = max(min(subsets, len(seen)), 1)
        parts += [seen[first::steps] for first in range(steps)]
    source = MemorySource(planes, origin=original.origin)
    sum_bytes_a_row = sum_bytes(4) + normal_bytes(source.sh_degree if bands else 0)
    with renderer.load(source, sum_bytes_a_row, references=True, view_sums=4) as scene:
        for part in original.progress.track(parts, "refitting colours", len(parts)):
            normal = ViewSums(renderer, scene, [normal_sums(renderer, bands)])
            try:
                for camera, view in zip(renderer.in_turn(scene, [cameras[view] for view in part]), part, strict=True):
                    normal.add_view(renderer.residual_sums(scene, camera, original.references[view]), camera)
                for rows, (sums,) in normal.parts():
                    for some, values in sums.parts(rows.start):
                        step_colours(planes, degrees, some, values, bands)
            finally:
                normal.release()
            scene.refresh(*fields)
    return planes


def normal_bytes(sh_degree: int) -> int:
    """Bytes a row that `normal_sums` take on the backend."""
    return 16 * (sh_degree + 1) ** 2


def normal_sums(renderer: Renderer, bands: bool = True) -> Maker:
    """Maker of the sums over views for a step of the refit: back-projected residuals and weights.

    They are made for every basis function, or without `bands` for the constant alone. Residual sums come first among a view's.
    """
    return partial(_ChunkNormal, renderer, bands)


class _ChunkNormal:
    """The sums of `normal_sums` for one chunk."""

    def __init__(self, renderer: Renderer, bands: bool, chunk: Chunk) -> None:
        self._renderer, self._count, self._degree = renderer, chunk.count, chunk.degree if bands else 0
        groups, functions = -(-chunk.stride // SUM_LANES), (self._degree + 1) ** 2
        self._array = renderer.backend.array((groups, functions, 4, SUM_LANES), np.float32)
        renderer.backend.fill(self._array, 0)

    def add(self, chunk: Chunk, sums: Any, part: ViewPart) -> None:
        renderer = self._renderer
        renderer.backend.launch(
            "sh_residual", (padded(part.count),), part.count, chunk.stride, part.base, part.first, self._degree,
            sums.shape[1], part.blocks, renderer.camera_array, chunk.means, sums, self._array,
        )  # fmt: skip

    def parts(self, base: int) -> Iterator[tuple[slice, np.ndarray]]:
        """Yield rows of the scene, where the chunk begins at row `base`, and their sums, valid until the next step.

        The sums are [K + 1, 4, rows] f32, for each basis function: residuals of three channels, and weight.
        """
        for rows, planes in planes_of(self._renderer.backend, self._array, self._count):
            yield slice(base + rows.start, base + rows.stop), planes.reshape(*self._array.shape[1:3], -1)

    def release(self) -> None:
        if self._array is not None:
            self._array.release()
            self._array = None


def step_colours(
    planes: dict[str, np.ndarray], degrees: np.ndarray, rows: slice, normal: np.ndarray, bands: bool = True
) -> None:
    """Take one step of the refit for some rows, in place.

    `planes`: stored planes ([width, n] f32 by field); colours of `rows` change. `degrees`: [n] u8, SH degrees of all
    rows. `rows`: the rows to change. `normal`: [K + 1, 4, rows] f32, their sums (`normal_sums`). Without `bands` those
    of the constant are enough. `bands`: change the SH above degree 0 too.
    """
    weight = np.where(normal[:, 3] > 0, normal[:, 3], np.float32(np.inf))
    # The constant's basis is Y_0 everywhere: its step in coefficients is 1 / Y_0 of the mean residual.
    moved = read_rows(planes["sh_dc"], rows) + np.float32(1 / SH_C0) * normal[0, :3] / weight[0]
    put_rows(planes["sh_dc"], rows, moved)
    if not bands or len(normal) == 1:
        return
    count = len(planes["sh_rest"]) // 3
    degree_of = np.repeat(np.arange(1, 5), [sh_rest_count(d) - sh_rest_count(d - 1) for d in range(1, 5)])
    rest = planes["sh_rest"].reshape(3, count, -1)
    stepped = np.empty((3, count, rows.stop - rows.start), np.float32)
    copy_rows(rest, rows, stepped)
    share = np.where(
        degrees[rows] >= degree_of[: len(normal) - 1, None], np.float32(RELAX_SH) / weight[1:], np.float32(0)
    )
    stepped[:, : len(share)] += normal[1:, :3].swapaxes(0, 1) * share
    put_rows(rest, rows, stepped)
