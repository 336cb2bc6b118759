"""Which Gaussians a multiplier keeps: chosen from the last round of pruning that it cuts by at most a round."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from flexgs_edge.constants import SH_C0
from flexgs_edge.goals.promise import bounds_ssim, mean_alone, means
from flexgs_edge.goals.target import Measurement, Target
from flexgs_edge.memory.storage import IN_MEMORY, Storage
from flexgs_edge.methods.best.allocation import BitModel, drop_bands, keep_most, keep_one
from flexgs_edge.methods.best.costs import RemovalCosts, Snapshot
from flexgs_edge.methods.best.rounds import PruneRounds
from flexgs_edge.scene.source import Planes

MOST_ROUNDS = 24  # Most rounds of pruning
FEW = 16  # Of fewer Gaussians none goes in a round


@dataclass
class Kept:
    """The Gaussians that a multiplier keeps."""

    snapshot: int  # number of the snapshot that they were chosen from
    rows: np.ndarray  # [n] i64, places in the rows of `PruneRounds`, ascending
    planes: dict[str, np.ndarray]  # stored planes of these rows ([width, n] f32 by field), with SH dropped
    degrees: np.ndarray  # [n] u8, SH degrees
    weight2: np.ndarray  # [n] f64, sums of squared weights
    left_out: int = 0  # how many rows were left out because the grid would be coarser with them (`reachable`)

    def take(self, keep: np.ndarray, storage: Storage = IN_MEMORY) -> Kept:
        """The rows for which `keep` ([n] bool) is True."""
        if keep.all():
            return self
        rows = np.flatnonzero(keep)
        planes = {name: storage.take(values, rows) for name, values in self.planes.items()}
        some, weight2 = storage.take(self.rows, rows), storage.take(self.weight2, rows)
        return Kept(self.snapshot, some, planes, self.degrees[rows], weight2)


@dataclass
class Selection:
    """Chooses from rounds of pruning."""

    rounds: PruneRounds  # more rounds are done when they are needed
    keep: float  # share that stays in a round
    # Rows to keep ([n] bool) and their SH degrees ([n] u8), from costs, bits and a multiplier.
    choose: Callable[[RemovalCosts, BitModel, float], tuple[np.ndarray, np.ndarray]]
    bits: BitModel  # bits of a Gaussian by SH degree
    most: int | None = None  # most Gaussians (`--max-gaussians`)
    begin: int = 0  # snapshots before this one do not count: a descent has changed all costs since
    missed_once: set[int] = field(default_factory=set)  # snapshots of which a candidate with about all rows missed

    @property
    def last(self) -> Snapshot:
        """What the last round has left."""
        return self.rounds.snapshots[-1]

    def prune(self, enough: Callable[[Snapshot], bool]) -> None:
        """Do rounds until the last snapshot is enough."""
        for _ in range(MOST_ROUNDS):
            if enough(self.last) or self.last.count < FEW:
                break
            self.rounds.descend(self.keep)

    def cut(self) -> float:
        """The multiplier that would cut the last snapshot by half a round more."""
        costs = self.last.costs.removal[self.last.costs.weight2 > 0]
        if not len(costs):
            return 1.0
        return max(float(np.quantile(costs, (1 - self.keep) / 2)) / self.bits.base, 1e-30)

    def kept(self, multiplier: float) -> Kept:
        """The rows that a multiplier keeps."""
        index, keep, degrees = self._chosen(multiplier)
        snapshot = self.rounds.snapshots[index]
        rows, storage = np.flatnonzero(keep), self.rounds.storage
        planes = drop_bands(snapshot.planes, rows, degrees[rows], snapshot.costs.sh_mean, SH_C0, storage)
        weight2 = storage.take(snapshot.costs.weight2, rows)
        return Kept(index, storage.take(snapshot.rows, rows), planes, degrees[rows], weight2)

    def missed(self, kept: Kept) -> None:
        """Tell of a candidate that missed.

        If it has about all that a descent left (97 %), a finer grid may do. After the second such miss, rows are chosen from what
        the descent before left.
        """
        begin = self.begin
        if kept.snapshot != begin or len(kept.rows) < 0.97 * self.rounds.snapshots[begin].count:
            return
        if begin in self.missed_once:
            self.begin = max((number for number in self.rounds.renewed if number < begin), default=0)
        self.missed_once.add(begin)

    def _chosen(self, multiplier: float) -> tuple[int, np.ndarray, np.ndarray]:
        for index in range(self.begin, self.begin + MOST_ROUNDS + 1):
            if index == len(self.rounds.snapshots):
                self.rounds.descend(self.keep)
            snapshot = self.rounds.snapshots[index]
            keep, degrees = self.choose(snapshot.costs, self.bits, multiplier)
            keep_one(keep, snapshot.costs)
            if self.most is not None:
                keep_most(keep, snapshot.costs, self.most)
            if keep.mean() >= self.keep or snapshot.count < FEW:
                break
        return index, keep, degrees


class Measure(Protocol):
    """Quality of planes ([width, n] f32 by field). With `estimate` it is a good guess that takes less time."""

    def __call__(self, planes: Planes, estimate: bool = False) -> Measurement: ...


class Guess:
    """Guesses the excess of planes.

    `measure`: quality of planes. `ssim_margin`: by how much SSIM is nearer to its bound than the mean, as a log. That changes
    little with compression or by a refit, so it is not measured each time: docs/results/tuning.md#lead
    """

    def __init__(self, measure: Measure) -> None:
        self._measure, self.ssim_margin = measure, 0.0

    def __call__(self, planes: Planes, target: Target) -> float:
        """Excess of planes by a target for quality, from the mean loss and the margin."""
        return mean_alone(target).excess(0, self._measure(planes, estimate=True)) + self.ssim_margin

    def learn(self, planes: Planes, target: Target) -> None:
        """Measure the margin, if SSIM is bounded."""
        if bounds_ssim(target):
            quality = self._measure(planes)
            self.ssim_margin = max(means(target).excess(0, quality) - mean_alone(target).excess(0, quality), 0.0)
