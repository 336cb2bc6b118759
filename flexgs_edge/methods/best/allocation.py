"""Rate-distortion allocation: one multiplier decides for every Gaussian what happens to it.

A Gaussian is removed, or kept with SH up to some degree, whichever has the least cost + multiplier * bits. We choose from the
last round of pruning that the multiplier cuts by at most a round.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from flexgs_edge.constants import SH_C0
from flexgs_edge.goals.promise import bounds_ssim, mean_alone, means
from flexgs_edge.goals.target import Measurement, Target
from flexgs_edge.memory.rows import put_rows, read_ahead
from flexgs_edge.memory.storage import IN_MEMORY, Storage
from flexgs_edge.methods.best.costs import RemovalCosts, Snapshot
from flexgs_edge.methods.best.rounds import PruneRounds
from flexgs_edge.scene.source import Planes

SH_FACTOR = 2.0
"""Factor on the costs of dropping SH. We measure them one Gaussian at a time. But neighbours on a surface lose the same
part of their view-dependent colour, and these errors add up: docs/results/tuning.md#sh_factor"""
REMOVAL_FACTOR = 1.3
"""Factor on the costs of removal, for the same reason: one cut removes many Gaussians, and we measure them one by one."""


@dataclass(frozen=True)
class BitModel:
    """Bits that a Gaussian takes in the file.

    The defaults are fixed. Asking the coder for its own bits near the answer takes time and does not make files smaller:
    docs/results/tuning.md#bitmodel
    """

    base: float = 50.0  # bits of a Gaussian without SH
    bands: tuple[float, ...] = (10.0, 8.0, 8.0, 8.0)  # bits that each SH degree from 1 adds

    def of_degree(self, degree: int) -> float:
        """Bits of a Gaussian kept with SH up to `degree`."""
        return self.base + sum(self.bands[:degree])


def choose(costs: RemovalCosts, bits: BitModel, multiplier: float) -> tuple[np.ndarray, np.ndarray]:
    """Choose the cheapest of {removed, SH 0, ..., SH D} by cost + multiplier * bits, for each Gaussian by itself.

    Gaussians that no pose sees stay, without SH, because no cost of theirs is known.

    `multiplier`: squared error that a bit is worth. Returns [n] bool kept, [n] u8 SH degree kept.
    """
    top, count = len(costs.sh), len(costs.removal)
    keep, degrees = np.empty(count, bool), np.empty(count, np.uint8)
    for rows, (removal, sh, weight2) in read_ahead(count, costs.removal, costs.sh, costs.weight2):
        lagrangian = [SH_FACTOR * sh[level] + multiplier * bits.of_degree(level) for level in range(top)]
        lagrangian.append(np.full(len(removal), multiplier * bits.of_degree(top)))
        unseen = weight2 <= 0
        degrees[rows] = np.where(unseen, 0, np.argmin(lagrangian, axis=0))
        keep[rows] = unseen | (REMOVAL_FACTOR * removal >= np.min(lagrangian, axis=0))
    return keep, degrees


def keep_one(keep: np.ndarray, costs: RemovalCosts) -> None:
    """Keep the row whose removal costs most (of equal ones the first), if `keep` has none that a pose sees.

    `keep`: [n] bool, from `choose` or `OneDegree`; changed in place. `costs`: squared errors.
    """
    dearest, most = 0, -1.0
    for rows, (removal, weight2) in read_ahead(len(keep), costs.removal, costs.weight2):
        here = np.where(weight2 > 0, removal, -1.0)
        if (keep[rows] & (weight2 > 0)).any():
            return
        if here.max() > most:
            dearest, most = rows.start + int(np.argmax(here)), float(here.max())
    if most >= 0:
        keep[dearest] = True


def keep_most(keep: np.ndarray, costs: RemovalCosts, most: int) -> None:
    """Keep no more than `most` rows: first go those that no pose sees, then those whose removal costs least.

    `keep`: [n] bool, from `choose` or `OneDegree`; changed in place.
    """
    over = int(np.count_nonzero(keep)) - most
    if over > 0:
        rows = np.flatnonzero(keep)
        worth = np.where(costs.weight2[rows] > 0, costs.removal[rows], -1.0)
        keep[rows[np.argsort(worth, kind="stable")[:over]]] = False


class OneDegree:
    """As `choose`, but with one SH degree for all rows, for formats in which zero SH take as many bytes as others.

    The degree never rises in a search: the costs of single rows say too much, and fine-tuning mends most of what SH were worth.
    """

    def __init__(self) -> None:
        self._most: int | None = None

    def __call__(self, costs: RemovalCosts, bits: BitModel, multiplier: float) -> tuple[np.ndarray, np.ndarray]:
        """See `choose`."""
        top = len(costs.sh)
        nothing = np.zeros_like(costs.removal)
        removal = REMOVAL_FACTOR * costs.removal
        lagrangian = [
            (SH_FACTOR * costs.sh[level] if level < top else nothing) + multiplier * bits.of_degree(level)
            for level in range((top if self._most is None else min(self._most, top)) + 1)
        ]
        self._most = int(np.argmin([np.minimum(removal, whole).sum() for whole in lagrangian]))
        keep = removal >= lagrangian[self._most]
        keep[costs.weight2 <= 0] = True
        return keep, np.full(len(keep), self._most, np.uint8)


def drop_bands(
    planes: dict[str, np.ndarray],  # [width, n] f32 by field; not changed
    rows: np.ndarray,  # [m] i64, ascending
    degrees: np.ndarray,  # [m] u8, the SH degree that each row keeps
    sh_mean: np.ndarray,  # [D, 3, n] f32, mean colour of the bands above each lower degree
    y0: float,  # value of the constant basis function
    storage: Storage = IN_MEMORY,  # where the new arrays live
) -> dict[str, np.ndarray]:
    """Take rows of planes and drop the SH above their degrees; the mean colour of these is added to the constant.

    Returns [width, m] f32 by field, in arrays of `storage`.
    """
    top = len(sh_mean)
    if top == 0:
        return {name: storage.take(values, rows) for name, values in planes.items()}
    kept = {name: storage.empty((len(planes[name]), len(rows)), np.float32) for name in ("sh_dc", "sh_rest")}
    # Taken and cleared in one pass: with scratch files, a second pass would write and read all planes again.
    for part, found in read_ahead(planes["means"].shape[1], sh_mean, planes["sh_dc"], planes["sh_rest"]):
        here = slice(*np.searchsorted(rows, (part.start, part.stop)).tolist())
        inside, some = rows[here] - part.start, degrees[here]
        means, colours, bands = (values.take(inside, axis=-1) for values in found)
        lower = np.minimum(some, top - 1).astype(np.int64)
        mean = np.take_along_axis(means, lower[None, None], axis=0)[0]
        put_rows(kept["sh_dc"], here, colours + np.where(some < top, mean, np.float32(0)) / np.float32(y0))
        bands = bands.reshape(3, (top + 1) ** 2 - 1, -1)
        for level in range(1, top + 1):
            bands[:, level * level - 1 : (level + 1) ** 2 - 1] *= some >= level
        put_rows(kept["sh_rest"], here, bands.reshape(len(kept["sh_rest"]), len(some)))
    return {name: kept[name] if name in kept else storage.take(values, rows) for name, values in planes.items()}


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

    def take(self, keep: np.ndarray, storage: Storage = IN_MEMORY) -> "Kept":
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
