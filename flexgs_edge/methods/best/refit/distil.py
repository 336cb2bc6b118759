"""Self-distillation: a short descent of all kept values towards the original's own renders. No photos, and nothing is added."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.methods.best.refit.descent import Descent
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.rotations import canonical_axes
from flexgs_edge.views.references import References

MEANS_RATE = 1.6e-4
"""Largest change of a position in a step, as a share of the cameras' extent (the reference program's first rate)."""
FIELD_RATES = {
    "log_scales": 1.5e-2,
    "quats": 3e-3,
    "opacity_logits": 5e-2,
    "sh_dc": 2.5e-3,
    "sh_rest": 2.5e-3 / 20,
}
"""The same of the other values: the reference program's, three times as much for scales and rotations. That program
takes tens of thousands of steps, ours hundreds: docs/results/tuning.md#field_rates"""
LAST = 0.1
"""Rates at the end as a share of those at the beginning, of the steps with geometry and of those without; they fall by the same
share at each step."""
ON_GRID, HOLDING = 0.5, 0.75
"""Shares of the steps before views are drawn from values on their grids, and before geometry is held there."""
HELD = ("means", "log_scales", "quats")
"""Fields that stay where they are from then on. Codes of geometry that flip back and forth move whole splats, so the
views that come last would decide: docs/results/tuning.md#held"""


@dataclass(frozen=True)
class Schedule:
    """How long a descent is, and how it goes.

    Parameters
    ----------
    steps : int
        Views looked at, one a step.
    rate : float
        Factor of all rates.
    on_grid, holding : float
        Shares of the steps before values are put on their grids for drawing, and before geometry is held there.
    """

    steps: int
    rate: float = 1.0
    on_grid: float = ON_GRID
    holding: float = HOLDING

    def parts(self, grid: bool) -> tuple[range, range, range]:
        """Steps off the grid, on it, and on it with geometry held (all of them off it where there is none)."""
        free, moving = (round(share * self.steps) if grid else self.steps for share in (self.on_grid, self.holding))
        return range(free), range(free, moving), range(moving, self.steps)

    def order(self, views: int) -> np.ndarray:
        """[steps] i64, which view each step looks at: all of them in a shuffled order, then in another."""
        rng = np.random.default_rng(0)
        rounds = [rng.permutation(views) for _ in range(-(-self.steps // max(views, 1)))]
        return np.concatenate([*rounds, np.zeros(0, np.int64)])[: self.steps]


def rates_for(cameras: Sequence[Camera]) -> dict[str, float]:
    """Rates of all fields; those of positions follow 1.1 times the largest distance of a camera from their mean."""
    centres = np.stack([camera.center for camera in cameras])
    extent = 1.1 * float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
    return {"means": MEANS_RATE * extent, **FIELD_RATES}


def distil(
    renderer: Renderer,
    planes: dict[str, np.ndarray],
    degrees: np.ndarray,
    origin: np.ndarray,
    cameras: Sequence[Camera],
    targets: References,
    schedule: Schedule,
    steps: StepSizes | None = None,
    progress: Progress = SILENT,
    rates: dict[str, float] | None = None,
) -> dict[str, np.ndarray]:
    """Move all values of a scene towards the original's renders.

    Parameters
    ----------
    planes : dict
        Stored planes of the kept Gaussians ([width, n] f32 by field); not changed.
    degrees : np.ndarray
        [n] SH degree kept for each row: coefficients above it stay zero.
    origin : np.ndarray
        [3] f64, as in `SceneSource`.
    targets : References
        The original from `cameras`.
    steps : StepSizes, optional
        The grid that the values will be put on: the last steps repair its rounding.

    Returns
    -------
    dict
        The values, not on any grid.

    Raises
    ------
    BudgetError
        When the scene does not fit into memory with what a descent remembers.
    """
    rates = {**rates_for(cameras), **(rates or {})}
    largest = max(cameras, key=lambda camera: camera.width * camera.height)
    # Quaternions in the form that the grid has; rows with SH first: chunks of the others are drawn and moved without.
    quats, log_scales = canonical_axes(planes["quats"], planes["log_scales"])
    ordered = {**planes, "quats": quats.astype(np.float32), "log_scales": log_scales}
    rows = np.argsort(degrees == 0, kind="stable")
    ordered = {name: np.ascontiguousarray(values[:, rows]) for name, values in ordered.items()}
    with Descent(renderer, ordered, degrees[rows], origin, largest) as descent:
        order = schedule.order(len(cameras))
        parts = schedule.parts(steps is not None)
        for place, part in enumerate(parts):
            held = HELD if place == 2 else ()
            # Rates fall while geometry moves, and again while it does not.
            falling = part if held else range(parts[1].stop)
            if place and len(part):
                descent.put_on(steps)
            for k in progress.track(part, f"distilling{' on the grid' if place else ''}", len(part)):
                now = schedule.rate * LAST ** ((k - falling.start) / len(falling))
                moving = {name: 0.0 if name in held else now * rate for name, rate in rates.items()}
                descent.step(cameras[order[k]], targets[order[k]], moving)
        moved = descent.planes()
    back = np.empty_like(rows)
    back[rows] = np.arange(len(rows))
    return {name: values[:, back] for name, values in moved.items()}
