"""Layers: rows are ordered by importance, so that a file that is cut after a layer still decodes to a good scene.

Nothing is computed again when a file is cut: cutting drops the least important Gaussians.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.grid.grid_scene import GridScene, values_of
from flexgs_edge.memory.rows import put_rows, read_ahead
from flexgs_edge.methods.best.allocation import BitModel
from flexgs_edge.methods.best.costs import cost_bytes, measure_costs
from flexgs_edge.methods.best.memory_plan import SPILLED_ROW_BYTES
from flexgs_edge.methods.best.rounds import take_rows
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.render.fit import sum_bytes
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.source import MemorySource, growth

MOST_SORTED = 1 << 18  # So many rows may always be sorted. Of more, see `can_sort`.
SORTED_ROW_BYTES = 41
"""Bytes of memory that sorting takes for each row, even if the scene lies in scratch files: see `worthiest`."""


def can_sort(rows: int, original: int) -> bool:
    """Whether rows can be sorted in the memory that the search of a scene of `original` Gaussians had for its lists of rows.

    The answer must not depend on the memory limit, as the same command makes the same bytes under each.
    """
    return rows <= MOST_SORTED or rows * SORTED_ROW_BYTES <= original * SPILLED_ROW_BYTES


def assign_layers(
    grid: GridScene,  # the scene to sort
    layers: int,  # how many to make, at least 2
    bits: BitModel,  # bits that the coder takes for a row of each SH degree
    renderer: Renderer,  # draws the views
    cameras: Sequence[Camera],  # the scored poses
    progress: Progress = SILENT,  # told of each view
) -> GridScene:
    """Sort the Gaussians into layers by cost of removal for each bit.

    Costs are measured again after each fifth of the bits on the decoded scene, because a cut file has no refit. What is left is
    measured as large as viewers draw it (`growth`). Gaussians that no pose sees come last.

    Returns the same Gaussians in the order of their layers.
    """
    storage = renderer.storage
    planes, left, layer = values_of(grid, storage), np.arange(grid.count), np.zeros(grid.count, np.uint8)
    part = 0.485  # Below .5, so that half of a file's bytes hold all layers but the last one, and the header
    for level in range(layers - 1, 0, -1):
        layer[left] = level
        left = worthiest(planes, grid.sh_degrees, left, part, bits, renderer, cameras, grid.origin, progress)
        layer[left] = 0
    order = np.argsort(layer, kind="stable")
    return replace(grid.take(order, storage), layer=layer[order])


def worthiest(
    planes: dict[str, np.ndarray],  # stored planes ([width, n] f32 by field)
    degrees: np.ndarray,  # [n] u8, SH degrees
    left: np.ndarray,  # [k] i64, rows to choose from
    part: float,  # above 0, at most 1
    bits: BitModel,  # bits of a row of each SH degree
    renderer: Renderer,
    cameras: Sequence[Camera],
    origin: np.ndarray,  # [3] f64, as in `SceneSource`
    progress: Progress = SILENT,
    keep: float = 0.8,
) -> np.ndarray:
    """What stays of the rows `left` when all but `part` of their bits are gone, a part at a time. It is never empty.

    `renderer`, `cameras`, `progress`: as for `assign_layers`. `keep`: share of the bits that stays before costs are
    measured again, because removed Gaussians interact: docs/results/tuning.md#layers
    """
    storage = renderer.storage
    cost = np.array([bits.of_degree(degree) for degree in range(int(degrees.max(initial=0)) + 1)])
    spent = cost[degrees[left]]
    end = part * spent.sum()
    while len(left) > 1 and spent.sum() > end:
        kept = take_rows(planes, left, storage)
        for rows, (scales,) in read_ahead(len(left), kept["log_scales"]):
            put_rows(kept["log_scales"], rows, scales + growth(len(left), len(degrees)))
        with renderer.load(MemorySource(kept, origin=origin), sum_bytes(2) + cost_bytes(0)) as scene:
            costs = measure_costs(renderer, scene, cameras, sh_costs=False, progress=progress)
        del kept
        worth = costs.removal / spent
        worth[costs.weight2 <= 0] = -1.0
        order = np.argsort(worth, kind="stable")
        del costs, worth
        spent = spent[order]
        gone = np.cumsum(spent, out=spent)
        goal = gone[-1] - max(end, keep * gone[-1])
        left = np.delete(left, order[: min(int(np.searchsorted(gone, goal)) + 1, len(left) - 1)])
        del order, gone
        spent = cost[degrees[left]]
    return left
