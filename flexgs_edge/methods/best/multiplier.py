"""The search over one multiplier, shared by `.fgs` and other formats.

The multiplier is the Lagrange multiplier (lambda) of the rate: the squared error that one bit is worth. It decides which
Gaussians stay, with which SH degree, and how fine the grid is. The search looks for the multiplier whose file just meets
the target.
"""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Generic, Protocol

import numpy as np

from flexgs_edge.constants import SH_C0
from flexgs_edge.errors import TargetError
from flexgs_edge.goals.promise import bounds_ssim, broken_views, mean_alone, means
from flexgs_edge.goals.steps import better, obstacle
from flexgs_edge.goals.target import Measurement, Target
from flexgs_edge.methods.best.allocation import BitModel, choose, drop_bands, keep_most, keep_one
from flexgs_edge.methods.best.candidates import Candidate, Product, RateResult, next_multiplier
from flexgs_edge.methods.best.costs import RemovalCosts
from flexgs_edge.methods.best.effort import Effort
from flexgs_edge.methods.best.kept import Kept
from flexgs_edge.methods.best.rounds import PruneRounds
from flexgs_edge.methods.best.snapshot import Snapshot

LOG = logging.getLogger("flexgs_edge")


class Measure(Protocol):
    """Quality of planes ([width, n] f32 by field). With `estimate` it is a good guess that takes less time."""

    def __call__(self, planes: dict[str, np.ndarray], estimate: bool = False) -> Measurement: ...


PRUNED_PART = 0.45
"""Share of the allowed loss that pruning alone uses up when a candidate meets the target. The search starts there:
docs/results/tuning.md#pruned_part"""
MOST_ROUNDS = 24
"""Most rounds of pruning."""
EXTRA_STEPS = 4
"""Most candidates beyond the effort's own, while none holds or the best is far below the target."""
FLAT = 0.1
"""If two candidates have the most Gaussians allowed, and the log of the loss differs by less, the search ends."""
SAME_COUNT, HEMMED = 0.01, 0.65
"""If of two candidates one holds and one misses, and the logs of their counts differ by less than the first, only their grids
differ. Then chance decides as much as the multiplier does. The search ends once the logs of their sizes differ by less than the
second, as a share of `Effort.close`: docs/results/tuning.md#hemmed"""
BROKEN = 2
"""So many candidates in a row that break views ask for more poses: docs/results/tuning.md#needed"""
LEAD_FROM = 1.0
"""Rounds of pruning measure SSIM once, as soon as the log of the loss is this near to their end. Where less is lost, SSIM says
little about the end: docs/results/tuning.md#lead"""


class PosesLacking(Exception):
    """Candidates in a row broke the bound on the worst view: scored poses see too little of what a view shows.

    Parameters
    ----------
    views : sequence of int
        Places of the broken views among those that decide.
    steps : sequence of Candidate
        The candidates.
    """

    def __init__(self, views: Sequence[int], steps: Sequence[Candidate]) -> None:
        super().__init__("views lose too much")
        self.views, self.steps = tuple(views), tuple(steps)


class MultiplierSearch(ABC, Generic[Product]):
    """Searches the multiplier whose candidate meets a target with the fewest bytes.

    Parameters
    ----------
    rounds : PruneRounds
        Snapshots to choose from. The search does more rounds if it needs them.
    measure : callable
        Quality of planes without quantization, to find where the search starts.
    effort : Effort
        How much work to spend.
    on_step : callable, optional
        Called with each candidate.

    Attributes
    ----------
    most : int or None
        Most Gaussians of a candidate (`--max-gaussians`).
    asks : bool
        Whether `run` raises `PosesLacking`.
    ended : bool
        Whether the search was interrupted and answers with what it has.
    """

    pruned_part = PRUNED_PART
    """Share of the allowed loss at which the first rounds stop."""
    keeps_best = False
    """Whether an interrupted search answers with its best candidate so far; for searches whose candidates take long."""

    def __init__(
        self,
        rounds: PruneRounds,
        measure: Measure,
        effort: Effort,
        on_step: Callable[[Candidate], None] | None = None,
    ) -> None:
        self.rounds, self.measure, self.effort, self.on_step = rounds, measure, effort, on_step
        self.bits = BitModel()
        self.most: int | None = None
        self.asks = False
        self.ended = False
        self._lead, self._begin = 0.0, 0

    @abstractmethod
    def _whole(self, multiplier: float, target: Target) -> tuple[Candidate, Product]:
        """Make and measure the candidate of a multiplier."""

    def _aim(self, multiplier: float, steps: Sequence[Candidate], target: Target) -> float:
        """Improve the guess `multiplier` for the next candidate, in less time than a candidate takes."""
        return multiplier

    def _mended(
        self, missed: Candidate, product: Product, target: Target, tried: list[Candidate]
    ) -> tuple[Candidate, Product] | None:
        """What holds and is made of a candidate that does not, in less time than another takes. All results go to `tried`."""
        return None

    def _close(self, target: Target) -> float:
        """How far below the target a candidate ends the search (log of limit over loss or size)."""
        return self.effort.close

    def _used_up(self, steps: Sequence[Candidate]) -> bool:
        """Whether no other multiplier could do much better than the last of these candidates, which all missed a quality."""
        full = [step.excess for step in steps[-2:] if step.count == self.most]
        return len(full) == 2 and abs(full[1] - full[0]) < FLAT

    def discard(self, product: Product) -> None:
        """Free a product that is not the best any more."""
        return

    def interrupted(self) -> None:
        """Say that the best candidate so far is taken, and do nothing more to it."""
        LOG.warning("interrupted: the best result so far is taken")
        self.ended = True

    def choose(self, costs: RemovalCosts, multiplier: float) -> tuple[np.ndarray, np.ndarray]:
        """Rows to keep ([n] bool), and their SH degrees ([n] u8)."""
        return choose(costs, self.bits, multiplier)

    def run(self, target: Target, best_effort: bool = False) -> RateResult[Product]:
        """Search for the best candidate.

        Parameters
        ----------
        target : Target
            What must hold.
        best_effort : bool
            Answer with the closest candidate if none holds.

        Returns
        -------
        RateResult
            The product of the best candidate, and all candidates.

        Raises
        ------
        TargetError
            When no candidate holds and `best_effort` is not set; it names the closest one.
        PosesLacking
            When `BROKEN` candidates in a row break views and none holds, if the search `asks`. Their products are freed.
        """
        steps: list[Candidate] = []
        tried: list[Candidate] = []
        best: tuple[Candidate, Product] | None = None
        multiplier = self._aim(self._start(target), steps, target)
        for count in range(self.effort.steps + EXTRA_STEPS):
            try:
                step, product = self._whole(multiplier, target)
            except KeyboardInterrupt:
                if best is None or not self.keeps_best:
                    raise
                self.interrupted()
                break
            steps.append(step)
            if self.on_step:
                self.on_step(step)
            broken = self._broken(steps, target)
            if broken:
                for made in [product] if best is None else [product, best[1]]:
                    self.discard(made)
                raise PosesLacking(broken, (*steps, *tried))
            mended = None if step.holds else self._mended(step, product, target, tried)
            if mended is not None:
                self.discard(product)
                step, product = mended
            if best is None:
                best = (step, product)
            elif better(step, best[0], target):
                self.discard(best[1])
                best = (step, product)
            else:
                self.discard(product)
            close = best[0].holds and (best[0].excess > -self._close(target) or self._hemmed_in(best[0], steps, target))
            enough = best[0].holds and best[0].excess > -self.effort.far and count + 1 >= self.effort.steps
            # A size that is missed can always be met by a larger multiplier.
            in_vain = target.limit_bytes is None and not best[0].holds and self._used_up(steps)
            if mended is not None or self.ended or close or enough or in_vain or step.multiplier < 1e-30:
                break
            multiplier = self._aim(next_multiplier(steps, target), steps, target)
        assert best is not None
        chosen, product = best
        if not chosen.holds and not best_effort:
            last = ", with one Gaussian left" if target.limit_bytes is not None and chosen.count == 1 else ""
            if chosen.count == self.most:
                last += f", with as many Gaussians as --max-gaussians {self.most} allows"
            raise TargetError(
                f"{target.describe()} is out of reach; the closest point has {target.report(chosen.size, chosen.measurement)}"
                f"{last} (--best-effort writes it){obstacle(target, chosen)}"
            )
        return RateResult(product, chosen, chosen.holds, (*steps, *tried))

    def _hemmed_in(self, best: Candidate, steps: Sequence[Candidate], target: Target) -> bool:
        """Whether a candidate of as many Gaussians misses and is so little smaller that another one is not worth its time."""
        missed = [
            step.size
            for step in steps
            if not step.holds and step.size < best.size and abs(math.log(step.count / best.count)) < SAME_COUNT
        ]
        return bool(missed) and math.log(best.size / max(missed)) < HEMMED * self._close(target)

    def _broken(self, steps: Sequence[Candidate], target: Target) -> list[int]:
        """Views that the last candidates broke, if the search asks for poses: each of these broke one, and none so far holds."""
        if not self.asks or target.limit_bytes is not None or len(steps) < BROKEN or any(step.holds for step in steps):
            return []
        broken = [broken_views(target, step.measurement) for step in steps[-BROKEN:]]
        return sorted(set().union(*broken)) if all(broken) else []

    def _start(self, target: Target) -> float:
        """Prune until pruning alone has used up its share of the target; returns the multiplier of that cut."""
        self._prune(target, self.pruned_part)
        return self._cut(self.rounds.snapshots[-1])

    def _prune(self, target: Target, part: float, times: float = 1.0) -> None:
        """Prune until pruning alone loses `part` of what the target allows, or `times` the rows are left that a size allows."""
        for _ in range(MOST_ROUNDS):
            last = self.rounds.snapshots[-1]
            if target.limit_bytes is not None:
                if last.count * self.bits.base / 8 <= times * target.limit_bytes:
                    break
            elif len(self.rounds.snapshots) > 1:
                excess, end = self._guess(last.planes, target), math.log(part)
                if bounds_ssim(target) and self._lead == 0.0 and excess >= end - LEAD_FROM:
                    self._learn_lead(last.planes, target)
                    excess += self._lead
                if excess >= end:
                    break
            if last.count < 16:
                break
            self.rounds.descend(self.effort.keep)

    def _guess(self, planes: dict[str, np.ndarray], target: Target) -> float:
        """Excess of planes by a target for quality, guessed from the mean drop.

        Where SSIM is nearer to its bound, we add by how much. That changes little with compression or by a refit, so it is not
        measured each time: docs/results/tuning.md#lead
        """
        return mean_alone(target).excess(0, self.measure(planes, estimate=True)) + self._lead

    def _learn_lead(self, planes: dict[str, np.ndarray], target: Target) -> None:
        """Measure by how much SSIM is nearer to its bound than the mean."""
        quality = self.measure(planes)
        self._lead = max(means(target).excess(0, quality) - mean_alone(target).excess(0, quality), 0.0)

    def _cut(self, snapshot: Snapshot) -> float:
        """The multiplier that would cut a snapshot by half a round more."""
        costs = snapshot.costs.removal[snapshot.costs.weight2 > 0]
        if not len(costs):
            return 1.0
        share = (1 - self.effort.keep) / 2
        return max(float(np.quantile(costs, share)) / self.bits.base, 1e-30)

    def _snapshot(self, multiplier: float) -> tuple[int, np.ndarray, np.ndarray]:
        """First snapshot that this multiplier cuts by at most a round: its number, and the choice. Does more rounds if needed.

        Snapshots before `_begin` do not count: descents have changed all costs since.
        """
        for index in range(self._begin, self._begin + MOST_ROUNDS + 1):
            if index == len(self.rounds.snapshots):
                self.rounds.descend(self.effort.keep)
            snapshot = self.rounds.snapshots[index]
            keep, degrees = self.choose(snapshot.costs, multiplier)
            keep_one(keep, snapshot.costs)
            if self.most is not None:
                keep_most(keep, snapshot.costs, self.most)
            if keep.mean() >= self.effort.keep or snapshot.count < 16:
                break
        return index, keep, degrees

    def kept(self, multiplier: float) -> Kept:
        """The rows that a multiplier keeps."""
        index, keep, degrees = self._snapshot(multiplier)
        snapshot = self.rounds.snapshots[index]
        rows, storage = np.flatnonzero(keep), self.rounds.storage
        planes = drop_bands(snapshot.planes, rows, degrees[rows], snapshot.costs.sh_mean, SH_C0, storage)
        weight2 = storage.take(snapshot.costs.weight2, rows)
        return Kept(index, storage.take(snapshot.rows, rows), planes, degrees[rows], weight2)
