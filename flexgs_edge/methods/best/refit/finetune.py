"""Fine-tunes all values of the remaining Gaussians against renders of the original.

It needs no photos and adds no Gaussians, so the result cannot look better than the original.
"""

from dataclasses import dataclass

import numpy as np

from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.memory.rows import put_rows, read_ahead
from flexgs_edge.memory.storage import Storage
from flexgs_edge.methods.best.refit.descent import bit_prices
from flexgs_edge.methods.best.refit.streamed_descent import open_descent
from flexgs_edge.scene.rotations import canonical_axes
from flexgs_edge.views.references import Original

FIELD_RATES = {"log_scales": 4e-2, "quats": 4.8e-3, "opacity_logits": 8e-2, "sh_dc": 8e-3, "sh_rest": 1e-3}
"""Largest changes of the other values in a step: 1.6 (opacities) to 8 times (scales, SH) the reference program's. That program
takes tens of thousands of steps, ours hundreds: docs/results/tuning.md#field_rates"""
STRUCTURE, MARGIN_STRUCTURE, FULL_MARGIN = 0.02, 0.04, 0.3
"""Weights of 1 - SSIM in the loss, in units of a squared error, where the mean decides and where SSIM does; and the margin
of SSIM from which the second one holds in full, the log of how much more of its bound SSIM has used than the mean:
docs/results/tuning.md#led_structure"""
LAST_HELD = 0.03  # Rates at the end as a share of those at the beginning, while geometry is held
HELD = ("means", "log_scales", "quats")
"""Fields that are held in the last steps. Codes of geometry that flip back and forth would move whole splats, and the
last views would decide where they stay: docs/results/tuning.md#held"""


@dataclass(frozen=True)
class Schedule:
    """Length and course of a descent; chosen in docs/results/tuning.md#together, with 4 and 6 looks at each pose."""

    iterations: int  # how many views it looks at, one a step
    rate: float = 1.0  # factor on all rates
    # Rates at the end as a share of those at the beginning, while geometry moves. They fall by the same factor at each
    # step. With more, the views that come last decide too much: docs/results/tuning.md#last
    last: float = 0.06
    on_grid: float = 0.5  # share of the steps before views are drawn from values on their grids
    holding: float = 0.75  # share before geometry is held there
    # Squared error over all scored poses that a bit on the grid is worth. 0 (default): bits cost nothing.
    multiplier: float = 0.0
    # Largest change of a position in a step, as a share of `Original.depth`. With more, positions shake.
    means_rate: float = 0.9e-4
    mean_views: float = 0.25  # values on their grids are averaged over this many steps for each view
    # Weight of bits in the loss. It is above 1, since most Gaussians are not shown in all poses, and steps move only
    # those that are shown: docs/results/tuning.md#bit_weight
    bit_weight: float = 5.0

    def parts(self, grid: bool) -> tuple[range, range, range]:
        """Steps off the grid, on it, and on it with geometry held. Without a grid, all steps are off it."""
        free, moving = (
            round(share * self.iterations) if grid else self.iterations for share in (self.on_grid, self.holding)
        )
        return range(free), range(free, moving), range(moving, self.iterations)

    def order(self, views: int, turns: np.ndarray | None = None) -> np.ndarray:
        """[iterations] i64, the view of each step: all views in a shuffled order, then all again in another order.

        With `turns`, a round has as many steps, and a view comes as often as its share of their sum says; what a round
        leaves over counts in the next.
        """
        rng = np.random.default_rng(0)
        shares = np.ones(views) if turns is None else turns * (views / turns.sum())
        due, rounds, left = np.zeros(views), [np.zeros(0, np.int64)], self.iterations if views else 0
        while left > 0:
            due += shares
            times = np.floor(due + 1e-9).astype(np.int64)
            due -= times
            rounds.append(rng.permutation(np.repeat(np.arange(views), times)))
            left -= len(rounds[-1])
        return np.concatenate(rounds)[: self.iterations]


def structure_of(ssim_margin: float) -> float:
    """Weight of 1 - SSIM in the loss where SSIM is nearer to its bound than the mean by `ssim_margin`, 0 or more."""
    return STRUCTURE + (MARGIN_STRUCTURE - STRUCTURE) * min(ssim_margin / FULL_MARGIN, 1.0)


def finetune(
    planes: dict[str, np.ndarray],  # stored planes of the kept Gaussians ([width, n] f32 by field); not changed
    degrees: np.ndarray,  # [n] u8, SH degree kept for each row. Coefficients above it stay zero.
    original: Original,
    schedule: Schedule,  # number of steps, and when the grid comes in
    step_sizes: StepSizes | None = None,
    structure: float = STRUCTURE,  # weight of 1 - SSIM in the loss, beside the squared error
) -> dict[str, np.ndarray]:
    """Move all values of a scene towards the original's renders.

    `original`: the scored poses and those between them, with the original's renders. Its renderer has nothing loaded.
    `step_sizes`: of the grid that the values will be put on. The last steps then compensate for its rounding. Returns
    the values ([width, n] f32 by field), not rounded to any grid, in the renderer's storage. Raises `BudgetError` when
    the scene, its gradients and their running means do not fit into memory, and the renderer's storage has no files.
    """
    cameras = original.poses
    rates = {"means": schedule.means_rate * original.depth, **FIELD_RATES}
    largest = max(cameras, key=lambda camera: camera.width * camera.height)
    renderer, storage = original.renderer, original.renderer.storage
    # Rows with SH come first, so that the other chunks are drawn without SH.
    rows = np.argsort(degrees == 0, kind="stable")
    ordered, degrees = _canonical(planes, rows, storage), degrees[rows]
    with open_descent(renderer, ordered, degrees, original.origin, largest, structure) as descent:
        if step_sizes is not None and schedule.multiplier > 0 and len(degrees):
            worth = schedule.bit_weight * schedule.multiplier / len(original.cameras)
            descent.price(bit_prices(ordered, degrees, step_sizes, worth))
        order = schedule.order(len(cameras), original.turns)
        parts = schedule.parts(step_sizes is not None)
        for place, part in enumerate(parts):
            held = HELD if place == 2 else ()
            # Rates fall while geometry moves, and fall again while it is held.
            falling, last = (part, LAST_HELD) if held else (range(parts[1].stop), schedule.last)
            if place and len(part):
                if held and len(parts[1]):
                    descent.settle()
                descent.put_on(step_sizes)
            for k in original.progress.track(part, f"fine-tuning{' on the grid' if place else ''}", len(part)):
                now = schedule.rate * last ** ((k - falling.start) / len(falling))
                moving = {name: 0.0 if name in held else now * rate for name, rate in rates.items()}
                # On the grid, a plain mean first, then one that forgets: single views then decide little.
                share = (
                    max(1.0 / (k - part.start + 1), 1.0 / max(schedule.mean_views * len(cameras), 1.0))
                    if place
                    else 0.0
                )
                descent.step(cameras[order[k]], original.references[order[k]], moving, share)
        if len(parts[1]) or len(parts[2]):
            descent.settle()
        moved = descent.planes()
    back = np.empty_like(rows)
    back[rows] = np.arange(len(rows))
    return {name: storage.take(values, back) for name, values in moved.items()}


def _canonical(planes: dict[str, np.ndarray], rows: np.ndarray, storage: Storage) -> dict[str, np.ndarray]:
    """The listed rows, with quaternions in the form that the grid has."""
    taken = {name: storage.take(values, rows) for name, values in planes.items()}
    for part, (quats, log_scales) in read_ahead(len(rows), taken["quats"], taken["log_scales"]):
        quats, log_scales = canonical_axes(quats, log_scales)
        put_rows(taken["quats"], part, quats.astype(np.float32))
        put_rows(taken["log_scales"], part, log_scales)
    return taken
