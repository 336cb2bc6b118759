"""FOA for measured costs: a search over one multiplier, along one path of prune and rescore.

Every step is a whole result: choice, steps, grid, refit, code, and its measured quality, so the answer is always a point that
was itself measured to hold. Steps are counted, never timed: same command, same bytes.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from flexgs_edge.adapt import Measurement, Target
from flexgs_edge.best.choice import BitModel, choose, drop_bands
from flexgs_edge.best.path import PrunePath, Snapshot, take_rows
from flexgs_edge.best.steps import Slopes, choose_steps, holdable, probe_slopes
from flexgs_edge.constants import SH_C0
from flexgs_edge.errors import TargetError
from flexgs_edge.grid import GridScene, Steps, from_grid, recolour, to_grid
from flexgs_edge.refit import refit_colours

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
MENDED = 0.6
"""Loss after the colour refit over the loss before it, until a whole result tells (fox and the sample scene: see PROBES)."""
PROBES = 3
"""Unmended results that are looked at between two whole ones, at most: a tenth of the time each."""
EXTRA_STEPS = 3
"""Steps beyond the effort's own while nothing close to the target holds."""
AIM = -0.01
"""Excess that steps aim at."""
NEAREST = 0.1
"""A new step keeps this share of the interval between its neighbours away from both: curves are not quite smooth."""
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
    subsets : int
        Steps a round, as for `refit_colours`.
    steps : int
        Whole results that are measured, at most while something holds.
    close : float
        Excess (log of loss over limit) that ends the search when it is no farther below the target: 0.03 are about 1.5 % of
        the bytes.
    views : int
        Most scored poses.
    """

    keep: float
    refit_rounds: int
    subsets: int
    steps: int
    close: float
    views: int


EFFORTS = {
    "fast": Effort(keep=0.66, refit_rounds=1, subsets=4, steps=2, close=0.08, views=24),
    "balanced": Effort(keep=0.8, refit_rounds=1, subsets=6, steps=3, close=0.04, views=96),
    "thorough": Effort(keep=0.88, refit_rounds=2, subsets=6, steps=6, close=0.015, views=400),
}


@dataclass
class _Mended:
    """Colours after a refit, by row of the scene (ascending): where the next refit starts."""

    rows: np.ndarray
    degrees: np.ndarray
    planes: dict[str, np.ndarray]

    @classmethod
    def of(cls, rows: np.ndarray, degrees: np.ndarray, planes: dict[str, np.ndarray]) -> _Mended:
        order = np.argsort(rows)
        return cls(rows[order], degrees[order], {name: planes[name][:, order] for name in ("sh_dc", "sh_rest")})

    def apply(self, rows: np.ndarray, degrees: np.ndarray, planes: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """`planes` with these colours where a row was kept with the same SH degree."""
        if not len(self.rows):
            return planes
        at = np.minimum(np.searchsorted(self.rows, rows), len(self.rows) - 1)
        same = np.flatnonzero((self.rows[at] == rows) & (self.degrees[at] == degrees))
        changed = {name: planes[name].copy() for name in self.planes}
        for name, values in changed.items():
            # A grid may have lost its highest degrees: coefficients are channel by channel.
            mended = self.planes[name].reshape(3, -1, len(self.rows))
            values.reshape(3, -1, len(rows))[:, : mended.shape[1], same] = mended[:, :, at[same]]
        return {**planes, **changed}


@dataclass
class _Choice:
    """What a multiplier keeps: rows of the scene, their planes and SH degrees, and the grid steps."""

    rows: np.ndarray
    planes: dict[str, np.ndarray]
    degrees: np.ndarray
    steps: Steps


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
class RateResult:
    """The answer of a search: the grid to write and the way to it."""

    grid: GridScene
    chosen: RateStep
    reached: bool
    steps: tuple[RateStep, ...]


class RateSearch:
    """Searches the multiplier whose whole result meets a target with the fewest bytes.

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
        refit: bool = True,
        on_step: Callable[[RateStep], None] | None = None,
    ) -> None:
        self.path, self.size_of, self.measure = path, size_of, measure
        self.effort, self.refit, self.on_step = effort, refit, on_step
        self.bits = BitModel()
        self._slopes: dict[int, Slopes] = {}
        self._mended: _Mended | None = None

    def run(self, target: Target, best_effort: bool = False) -> RateResult:
        """Search; raises `TargetError` with the closest point when nothing holds and `best_effort` is not set."""
        steps: list[RateStep] = []
        best: tuple[RateStep, GridScene] | None = None
        multiplier = self._start(target)
        self._calibrate(multiplier)
        # A refit changes the size by little, the loss by much.
        offset = math.log(MENDED) if self.refit and target.limit_bytes is None else 0.0
        multiplier = self._aim(target, multiplier, offset)
        for count in range(self.effort.steps + EXTRA_STEPS):
            step, grid = self._whole(multiplier, target)
            steps.append(step)
            if self.on_step:
                self.on_step(step)
            if best is None or _better(step, best[0], target):
                best = (step, grid)
            close = best[0].holds and best[0].excess > -self.effort.close
            if close or step.multiplier < 1e-30 or (best[0].holds and count + 1 >= self.effort.steps):
                break
            offset = step.excess - self._probe(multiplier, target)
            low, high = _bounds(steps)
            multiplier = self._aim(target, _next_multiplier(steps, target), offset, low, high)
        assert best is not None
        chosen, grid = best
        if not chosen.holds and not best_effort:
            raise TargetError(
                f"{target.describe()} is out of reach; the closest point has {target.report(chosen.size, chosen.measurement)}"
                " (--best-effort writes it)"
            )
        return RateResult(grid, chosen, chosen.holds, tuple(steps))

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
            keep, degrees = choose(snapshot.costs, self.bits, multiplier)
            if keep.mean() >= self.effort.keep or snapshot.count < 16:
                break
        return index, keep, degrees

    def _calibrate(self, multiplier: float) -> None:
        """Ask the coder what Gaussians cost near the answer. Once: or every step would search another function."""
        _, self.bits = self.size_of(self._unmended(multiplier))

    def _unmended(self, multiplier: float) -> GridScene:
        choice = self._choice(multiplier)
        return to_grid(choice.planes, choice.degrees, choice.steps, self.path.origin)[0]

    def _probe(self, multiplier: float, target: Target) -> float:
        """The excess of a multiplier's result without a refit of its own."""
        grid = self._unmended(multiplier)
        if target.limit_bytes is not None:
            return target.excess(self.size_of(grid)[0], None)
        return target.excess(0, self.measure(from_grid(grid)))

    def _aim(
        self, target: Target, multiplier: float, offset: float, low: float = -math.inf, high: float = math.inf
    ) -> float:
        """Move to where a whole result (a probe plus `offset`) should lie just below the target; the log stays in (low, high)."""
        slope = SIZE_SLOPE if target.limit_bytes is not None else SLOPE
        seen: list[tuple[float, float]] = []
        place = math.log(multiplier)
        for _ in range(PROBES):
            excess = self._probe(math.exp(place), target) + offset
            seen.append((place, excess))
            if abs(excess - AIM) < -AIM:
                break
            if len(seen) > 1 and seen[-1][0] != seen[-2][0]:
                measured = (seen[-1][1] - seen[-2][1]) / (seen[-1][0] - seen[-2][0])
                slope *= min(max(measured / slope, 0.4), 2.5)
            place += max(-LARGEST_STRIDE, min(LARGEST_STRIDE, (AIM - excess) / slope))
            place = max(min(place, high), low)
        return math.exp(place)

    def _choice(self, multiplier: float) -> _Choice:
        index, keep, degrees = self._snapshot(multiplier)
        snapshot = self.path.snapshots[index]
        rows = np.flatnonzero(keep)
        degrees, weight2 = degrees[rows], snapshot.costs.weight2[rows]
        planes = drop_bands(take_rows(snapshot.planes, rows), degrees, snapshot.costs.sh_mean[:, :, rows], SH_C0)
        if self._mended is not None:
            planes = self._mended.apply(snapshot.rows[rows], degrees, planes)
        if index not in self._slopes:
            self._slopes[index] = probe_slopes(self.path.renderer, snapshot.planes, self.path.origin, self.path.cameras)
        steps = choose_steps(self._slopes[index], weight2, degrees, len(snapshot.costs.sh), multiplier)
        return _Choice(snapshot.rows[rows], planes, degrees, holdable(steps, planes))

    def _whole(self, multiplier: float, target: Target) -> tuple[RateStep, GridScene]:
        started = time.perf_counter()
        choice = self._choice(multiplier)
        grid = self._finish(choice)
        size, _ = self.size_of(grid)
        measurement = self.measure(from_grid(grid))
        excess = target.excess(size, measurement)
        sh_count = int((choice.degrees > 0).sum())
        seconds = time.perf_counter() - started
        return RateStep(multiplier, len(choice.rows), sh_count, size, measurement, excess, seconds), grid

    def _finish(self, choice: _Choice) -> GridScene:
        """Geometry on its grid, all colours refitted, SH on their grid, the constant refitted, the constant on its grid."""
        path, planes, degrees, steps = self.path, choice.planes, choice.degrees, choice.steps
        fine = replace(steps, dc=steps.dc * FINE_COLOUR, sh=tuple(s * FINE_COLOUR for s in steps.sh))
        fine = holdable(fine, planes)
        grid, order = to_grid(planes, degrees, fine, path.origin)
        degrees = degrees[order]
        moved = from_grid(grid)
        if self.refit:
            shared = (path.origin, path.cameras, path.targets)
            moved = refit_colours(
                path.renderer,
                moved,
                degrees,
                *shared,
                rounds=self.effort.refit_rounds,
                subsets=self.effort.subsets,
                progress=path.progress,
            )
            self._mended = _Mended.of(choice.rows[order], degrees, moved)
            coarse = from_grid(
                recolour(
                    replace(grid, steps=replace(grid.steps, sh=steps.sh[: grid.sh_degree])),
                    moved["sh_dc"],
                    moved["sh_rest"],
                )
            )
            moved = refit_colours(
                path.renderer,
                coarse,
                degrees,
                *shared,
                rounds=1,
                bands=False,
                subsets=self.effort.subsets,
                progress=path.progress,
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


def _bounds(steps: Sequence[RateStep]) -> tuple[float, float]:
    """Logs of the multipliers of the nearest results that hold and that miss, away from both; infinite where none is."""
    holding = [math.log(s.multiplier) for s in steps if s.holds]
    missing = [math.log(s.multiplier) for s in steps if not s.holds]
    if not holding or not missing:
        return -math.inf, math.inf
    ends = (max(holding), min(missing)) if max(holding) < min(missing) else (min(holding), max(missing))
    low, high = min(ends), max(ends)
    room = NEAREST * (high - low)
    return low + room, high - room


def _next_multiplier(steps: Sequence[RateStep], target: Target) -> float:
    """Where the excess is expected to be just below zero: false position in the logs, kept away from points already asked."""
    slope = SIZE_SLOPE if target.limit_bytes is not None else SLOPE
    points = sorted((math.log(s.multiplier), s.excess) for s in steps)
    if slope < 0:
        points.reverse()
    # In the order of rising excess: the last point that holds before the first one that misses.
    first_miss = next((i for i, (_, excess) in enumerate(points) if excess > 0), len(points))
    if 0 < first_miss < len(points):
        (low, below), (high, above) = points[first_miss - 1], points[first_miss]
        part = (AIM - below) / (above - below)
        return math.exp(low + (high - low) * min(max(part, NEAREST), 1 - NEAREST))
    edge, excess = points[-1] if first_miss else points[0]
    most = LARGEST_STRIDE
    if len(points) > 1:
        # The slope between the two points nearest to the target, kept within reason.
        (low, below), (high, above) = points[-2:] if first_miss else points[:2]
        measured = (above - below) / (high - low) if high != low else slope
        slope *= min(max(measured / slope, 0.2), 3.0)
        most = 2 * LARGEST_STRIDE
    return math.exp(edge + max(-most, min(most, (AIM - excess) / slope)))
