"""FOA for measured costs: a search over one multiplier, along one path of prune and rescore.

Every step is a whole result: choice, steps, grid, refit, code, and its measured quality, so the answer is always a point that
was itself measured to hold. Steps are counted, never timed: same command, same bytes.
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np

from flexgs_edge.adapt import Measurement, Target
from flexgs_edge.adapt.line import CLOSE, next_point
from flexgs_edge.best.choice import BitModel, choose, drop_bands
from flexgs_edge.best.path import PrunePath, Snapshot, take_rows
from flexgs_edge.best.steps import Slopes, choose_steps, holdable, probe_slopes
from flexgs_edge.constants import SH_C0
from flexgs_edge.errors import TargetError
from flexgs_edge.grid import GridScene, Steps, from_grid, recolour, to_grid
from flexgs_edge.refit import refit_colours
from flexgs_edge.score.removal import RemovalCosts

Product = TypeVar("Product")
"""What a step makes: a grid, or a finished file."""

PRUNED_PART = 0.45
"""Part of the allowed loss that pruning alone has used up when a whole result meets the target (fox .45, the sample .55): where
the search starts."""
SLOPE = 0.6
"""Slope of the log of the drop over the log of the multiplier before two points are measured (fox .55 to .77)."""
SIZE_SLOPE = -0.45
"""The same for the log of the size."""
FINE_COLOUR = 2.0**-8
"""Colour steps before the refit, as a share of the final ones: only geometry shall move."""
MOST_ROUNDS = 24
EXTRA_STEPS = 3
"""Steps beyond the effort's own while nothing close to the target holds."""
LARGEST_STRIDE = 1.2
"""Largest change of the log of the multiplier between two steps."""


@dataclass(frozen=True)
class Effort:
    """How much work a search spends; fixed counts.

    Parameters
    ----------
    keep : float
        Share of the Gaussians that stays in each round of the path.
    refit_rounds : int
        Rounds on all coefficients before SH are put on their grid (one on the constant follows).
    steps : int
        Whole results that are measured.
    views : int
        Most scored poses.
    """

    keep: float
    refit_rounds: int
    steps: int
    views: int


EFFORTS = {
    "fast": Effort(keep=0.66, refit_rounds=1, steps=3, views=24),
    "balanced": Effort(keep=0.8, refit_rounds=2, steps=4, views=96),
    "thorough": Effort(keep=0.88, refit_rounds=4, steps=6, views=400),
}


@dataclass(frozen=True)
class RateStep:
    """One whole result that the search looked at.

    Parameters
    ----------
    multiplier : float
        Squared error that a bit is worth.
    count, sh_count : int
        Gaussians kept, and those with SH.
    size : int
        Bytes of the file.
    measurement : Measurement
    excess : float
        By how much the target was missed; zero or less holds.
    seconds : float
    """

    multiplier: float
    count: int
    sh_count: int
    size: int
    measurement: Measurement
    excess: float
    seconds: float

    @property
    def holds(self) -> bool:
        """The target holds here."""
        return self.excess <= 0.0


@dataclass(frozen=True)
class RateResult(Generic[Product]):
    """The answer of a search: what to write and the way to it."""

    product: Product
    chosen: RateStep
    reached: bool
    steps: tuple[RateStep, ...]


class MultiplierSearch(ABC, Generic[Product]):
    """Searches the multiplier whose whole result meets a target with the fewest bytes.

    Parameters
    ----------
    path : PrunePath
    measure : callable
        Quality of planes without quantization, where the search starts.
    effort : Effort
    keep_unseen : bool
        Keep Gaussians that no pose sees.
    on_step : callable, optional
        Called after each step.
    """

    def __init__(
        self,
        path: PrunePath,
        measure: Callable[[dict[str, np.ndarray]], Measurement],
        effort: Effort,
        keep_unseen: bool = True,
        on_step: Callable[[RateStep], None] | None = None,
    ) -> None:
        self.path, self.measure, self.effort = path, measure, effort
        self.keep_unseen, self.on_step = keep_unseen, on_step
        self.bits = BitModel()
        self.settled = 0.0
        """Excess below the target that ends the search whatever the effort; 0: all steps are taken."""

    @abstractmethod
    def _calibrate(self, multiplier: float) -> None:
        """Ask what Gaussians cost near the answer. Once: or every step would search another function."""

    @abstractmethod
    def _whole(self, multiplier: float, target: Target) -> tuple[RateStep, Product]:
        """The whole result at a multiplier, measured."""

    def discard(self, product: Product) -> None:
        """Let go of what is not the best any more."""
        return

    def choose(self, costs: RemovalCosts, multiplier: float) -> tuple[np.ndarray, np.ndarray]:
        """Which rows to keep ([n] bool), and their SH degrees."""
        return choose(costs, self.bits, multiplier, self.keep_unseen)

    def run(self, target: Target, best_effort: bool = False) -> RateResult[Product]:
        """Search; raises `TargetError` with the closest point when nothing holds and `best_effort` is not set."""
        steps: list[RateStep] = []
        best: tuple[RateStep, Product] | None = None
        multiplier = self._start(target)
        self._calibrate(multiplier)
        for count in range(self.effort.steps + EXTRA_STEPS):
            step, product = self._whole(multiplier, target)
            steps.append(step)
            if self.on_step:
                self.on_step(step)
            if best is None:
                best = (step, product)
            elif _better(step, best[0], target):
                self.discard(best[1])
                best = (step, product)
            else:
                self.discard(product)
            enough = best[0].holds and best[0].excess > -CLOSE
            settled = best[0].holds and best[0].excess > -self.settled
            if (count + 1 >= self.effort.steps and enough) or settled or step.multiplier < 1e-30:
                break
            multiplier = _next_multiplier(steps, target)
        assert best is not None
        chosen, product = best
        if not chosen.holds and not best_effort:
            raise TargetError(
                f"{target.describe()} is out of reach; the closest point has {target.report(chosen.size, chosen.measurement)}"
                " (--best-effort writes it)"
            )
        return RateResult(product, chosen, chosen.holds, tuple(steps))

    def _start(self, target: Target) -> float:
        """Walk down until pruning alone has used up its part of the target; the multiplier at that cut."""
        for _ in range(MOST_ROUNDS):
            last = self.path.snapshots[-1]
            if target.limit_bytes is not None:
                if last.count * self.bits.base / 8 <= target.limit_bytes:
                    break
            elif len(self.path.snapshots) > 1:
                excess = target.excess(0, self.measure(last.planes))
                if excess >= math.log(PRUNED_PART):
                    break
            if last.count < 16:
                break
            self.path.descend(self.effort.keep)
        return self._cut(self.path.snapshots[-1])

    def _cut(self, snapshot: Snapshot) -> float:
        """The multiplier at which a snapshot would lose half a round more."""
        costs = snapshot.costs.removal[snapshot.costs.weight2 > 0]
        if not len(costs):
            return 1.0
        share = (1 - self.effort.keep) / 2
        return max(float(np.quantile(costs, share)) / self.bits.base, 1e-30)

    def _snapshot(self, multiplier: float) -> tuple[int, np.ndarray, np.ndarray]:
        """The first snapshot that this multiplier would not cut by more than a round, and its choice; walks on if needed."""
        for index in range(MOST_ROUNDS + 1):
            if index == len(self.path.snapshots):
                self.path.descend(self.effort.keep)
            snapshot = self.path.snapshots[index]
            keep, degrees = self.choose(snapshot.costs, multiplier)
            if keep.mean() >= self.effort.keep or snapshot.count < 16:
                break
        return index, keep, degrees

    def kept(self, multiplier: float) -> tuple[int, dict[str, np.ndarray], np.ndarray, np.ndarray]:
        """What a multiplier keeps: the snapshot asked, planes with SH dropped, SH degrees ([n] u8), and squared weights."""
        index, keep, degrees = self._snapshot(multiplier)
        snapshot = self.path.snapshots[index]
        rows = np.flatnonzero(keep)
        planes = drop_bands(take_rows(snapshot.planes, rows), degrees[rows], snapshot.costs.sh_mean[:, :, rows], SH_C0)
        return index, planes, degrees[rows], snapshot.costs.weight2[rows]


class RateSearch(MultiplierSearch[GridScene]):
    """The search for the grid that is coded in container version 2.

    Parameters
    ----------
    path : PrunePath
    size_of : callable
        Exact bytes of a grid's file, and the coder's bit model.
    measure : callable
        Quality of a grid's decoded planes.
    """

    def __init__(
        self,
        path: PrunePath,
        size_of: Callable[[GridScene], tuple[int, BitModel]],
        measure: Callable[[dict[str, np.ndarray]], Measurement],
        effort: Effort,
        keep_unseen: bool = True,
        refit: bool = True,
        on_step: Callable[[RateStep], None] | None = None,
    ) -> None:
        super().__init__(path, measure, effort, keep_unseen, on_step)
        self.size_of, self.refit = size_of, refit
        self._slopes: dict[int, Slopes] = {}

    def _calibrate(self, multiplier: float) -> None:
        """Ask the coder what Gaussians cost near the answer. Once: or every step would search another function."""
        grid, _ = to_grid(*self._choice(multiplier), self.path.origin)
        _, self.bits = self.size_of(grid)

    def _choice(self, multiplier: float) -> tuple[dict[str, np.ndarray], np.ndarray, Steps]:
        """Planes of the Gaussians that this multiplier keeps, their SH degrees, and the grid steps."""
        index, planes, degrees, weight2 = self.kept(multiplier)
        snapshot = self.path.snapshots[index]
        if index not in self._slopes:
            self._slopes[index] = probe_slopes(self.path.renderer, snapshot.planes, self.path.origin, self.path.cameras)
        steps = choose_steps(self._slopes[index], weight2, degrees, len(snapshot.costs.sh), multiplier)
        return planes, degrees, holdable(steps, planes)

    def _whole(self, multiplier: float, target: Target) -> tuple[RateStep, GridScene]:
        started = time.perf_counter()
        planes, degrees, steps = self._choice(multiplier)
        grid = self._finish(planes, degrees, steps)
        size, _ = self.size_of(grid)
        measurement = self.measure(from_grid(grid))
        excess = target.excess(size, measurement)
        sh_count = int((degrees > 0).sum())
        seconds = time.perf_counter() - started
        return RateStep(multiplier, len(degrees), sh_count, size, measurement, excess, seconds), grid

    def _finish(self, planes: dict[str, np.ndarray], degrees: np.ndarray, steps: Steps) -> GridScene:
        """Geometry on its grid, all colours refitted, SH on their grid, the constant refitted, the constant on its grid."""
        path = self.path
        fine = replace(steps, dc=steps.dc * FINE_COLOUR, sh=tuple(s * FINE_COLOUR for s in steps.sh))
        fine = holdable(fine, planes)
        grid, order = to_grid(planes, degrees, fine, path.origin)
        degrees = degrees[order]
        moved = from_grid(grid)
        if self.refit:
            shared = (path.origin, path.cameras, path.targets)
            moved = refit_colours(
                path.renderer, moved, degrees, *shared, rounds=self.effort.refit_rounds, progress=path.progress
            )
            coarse = from_grid(
                recolour(
                    replace(grid, steps=replace(grid.steps, sh=steps.sh[: grid.sh_degree])),
                    moved["sh_dc"],
                    moved["sh_rest"],
                )
            )
            moved = refit_colours(
                path.renderer, coarse, degrees, *shared, rounds=1, bands=False, progress=path.progress
            )
        final = replace(grid.steps, dc=steps.dc, sh=steps.sh[: grid.sh_degree])
        return recolour(replace(grid, steps=final), moved["sh_dc"], moved["sh_rest"])


def _better(step: RateStep, other: RateStep, target: Target) -> bool:
    """Whether `step` is the better answer: holding before missing, then fewer bytes (a size target: less loss)."""
    if step.holds != other.holds:
        return step.holds
    if not step.holds:
        return step.excess < other.excess
    if target.limit_bytes is not None:
        return step.measurement.loss(target.judge) < other.measurement.loss(target.judge)
    return step.size < other.size


def _next_multiplier(steps: Sequence[RateStep], target: Target) -> float:
    """Where the excess is expected to be just below zero, in the log of the multiplier."""
    slope = SIZE_SLOPE if target.limit_bytes is not None else SLOPE
    return math.exp(next_point([(math.log(s.multiplier), s.excess) for s in steps], slope, LARGEST_STRIDE))
