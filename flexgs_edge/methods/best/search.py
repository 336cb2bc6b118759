"""The search of every maker of files: a few finished candidates, until the largest share of a bound is hardly below 1.

The multiplier is the Lagrange multiplier (lambda) of the rate: the squared error that one bit is worth. It decides which
Gaussians stay, with which SH degree, and how fine the grid is. With it the log of the share rises and the size falls, up to
noise. So candidates are placed by secant steps inside of a bracket: the largest multiplier that holds, and the least one beyond
it that misses. The best candidate then loses Gaussians until it hardly holds.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Generic, Protocol, TypeVar

from flexgs_edge.errors import TargetError
from flexgs_edge.goals.promise import by_quality, lost_views
from flexgs_edge.goals.steps import better, obstacle
from flexgs_edge.goals.target import Measurement, Target
from flexgs_edge.progress import LOG

NEAREST = 0.1
"""A new point keeps this share of the interval between its neighbours away from both, since curves are not quite smooth."""
MOST_TRIED = 6
"""Most candidates with those that lost Gaussians; while none holds, and of a size, most candidates."""
PLAIN = (
    2,
    4,
)  # Most candidates of a size without a descent, before the first one with: if one holds, and while none does
AIM = -0.01  # Log of the share that we aim at
SLOPE, SIZE_SLOPE = 0.7, -0.45
"""Slopes of the logs of the share and of the size over that of the multiplier, before two points are measured:
docs/results/tuning.md#slope"""
LARGEST_STRIDE = 1.2  # Largest change of the log of the multiplier beyond what is measured


def next_point(points: Iterable[tuple[float, float]], slope: float, stride: float, least: float = 0.5) -> float:
    """Position where the excess should be just below zero: false position, kept away from measured points.

    `points`: (position, excess) of the measured points, at least one. `slope`: excess per position, used before two points are
    measured. Its sign must be right. `stride`: largest move beyond all points; twice that once a slope has been measured.
    `least`: a measured slope counts as at least this share of `slope`. Points that differ by chance have no slope of their own.

    >>> round(next_point([(0.0, -1.0), (1.0, 1.0)], 2.0, 1.0), 3)
    0.495
    """
    points = sorted(points)
    if slope < 0:
        points.reverse()
    # Sorted by rising excess, these are the last point that holds and the first one that misses.
    first_miss = next((i for i, (_, excess) in enumerate(points) if excess > 0), len(points))
    if 0 < first_miss < len(points):
        (low, below), (high, above) = points[first_miss - 1], points[first_miss]
        part = (AIM - below) / (above - below)
        return low + (high - low) * min(max(part, NEAREST), 1 - NEAREST)
    edge, excess = points[-1] if first_miss else points[0]
    if len(points) > 1:
        # The slope between the two points nearest to the target, kept within bounds.
        (low, below), (high, above) = points[-2:] if first_miss else points[:2]
        measured = (above - below) / (high - low) if high != low else slope
        slope *= min(max(measured / slope, least), 3.0)
        stride *= 2
    return edge + max(-stride, min(stride, (AIM - excess) / slope))


def weighed(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The points for `next_point`; after several on one side, the other side's excess counts half for each beyond the first.

    This is the Illinois rule. The log of a loss is curved, so that plain false position would approach the target slowly.
    """
    sides = [excess <= 0.0 for _, excess in points]
    streak = next((count for count, side in enumerate(reversed(sides)) if side != sides[-1]), len(sides))
    far = 0.5 ** (streak - 1)
    return [
        (position, excess * (1.0 if side == sides[-1] else far))
        for (position, excess), side in zip(points, sides, strict=True)
    ]


Product = TypeVar("Product")  # Type of the product of a candidate: a grid, or a finished file


@dataclass(frozen=True)
class Candidate:
    """A finished result: coded and measured.

    `count`, `sh_count`: Gaussians kept, and those with SH.
    """

    multiplier: float  # squared error that a bit is worth
    count: int
    sh_count: int
    size: int  # bytes of the file
    measurement: Measurement  # quality of the result
    excess: float  # log of the largest share: the target holds at zero or less
    seconds: float  # time that making and measuring took
    # Gaussians that no scored pose sees and that were left out because the grid would be coarser with them.
    left_out: int = 0

    @property
    def holds(self) -> bool:
        """Whether this candidate meets the target."""
        return self.excess <= 0.0


class Maker(Protocol[Product]):
    """Makes the candidates of a search."""

    close: float  # How far below 1 the log of the largest share ends the search

    def start(self, target: Target) -> float:
        """Prune, and return a multiplier to begin with."""

    def probe(self, multiplier: float, target: Target) -> float | None:
        """Expected excess of the candidate of a multiplier, in less time than it takes; `None` if that is not known."""

    def make(self, multiplier: float, target: Target) -> tuple[Candidate, Product]:
        """The candidate of a multiplier, finished and measured."""

    def trim(
        self, chosen: Candidate, product: Product, target: Target, tell: Callable[[Candidate], None], most: int
    ) -> tuple[Candidate, Product]:
        """The best of a candidate that holds and of at most `most` that are made of it by the loss of Gaussians."""

    def see(self, views: Sequence[int]) -> bool:
        """Score poses beside these of the views that decide, too, from now on; False if that is not possible."""

    def discard(self, product: Product) -> None:
        """Free a product that is not the best any more."""


@dataclass(frozen=True)
class RateResult(Generic[Product]):
    """The answer of a search."""

    product: Product  # a grid, or a finished file
    chosen: Candidate  # the best candidate, which `product` belongs to
    reached: bool  # whether it meets the target
    steps: tuple[Candidate, ...]  # all candidates in the order of the search
    interrupted: bool = False  # whether Ctrl-C ended the search


def search_size(
    plain: Callable[[], Maker[Product]],  # begins the maker without a descent; it may be called twice
    fine: Callable[[], Maker[Product]],  # begins the maker with one
    target: Target,
    best_effort: bool = False,
    on_step: Callable[[Candidate], None] | None = None,
) -> RateResult[Product]:
    """Search for the best result of a size by two makers: a few candidates of the first, one of the second, then the better's.

    Where the size has room for about all rows, pruning for a descent loses more than the descent mends. Ctrl-C ends both.
    """
    first = search(plain(), target, *PLAIN, best_effort=True, on_step=on_step)
    if first.interrupted:
        return first
    try:
        maker = fine()
        found, other = search(maker, target, tried=1, best_effort=True, on_step=on_step), first
        # What they lose decides, also of one that is too large: it can lose Gaussians later.
        if by_quality(target, first.chosen.measurement) <= by_quality(target, found.chosen.measurement):
            del maker
            maker, found, other = plain(), first, found
            maker.probe(maker.start(target), target)  # as the search before began: step sizes depend on what stays then
        tried = MOST_TRIED - len(other.steps)
        last = search(maker, target, tried=tried, best_effort=True, on_step=on_step, begun=found)
    except KeyboardInterrupt:
        return replace(first, interrupted=True)
    best = last if better(last.chosen, other.chosen, target) else other
    if not best.reached and not best_effort:
        raise missed(target, best.chosen)
    return replace(best, steps=other.steps + last.steps, interrupted=last.interrupted)


def search(
    maker: Maker[Product],  # makes the candidates
    target: Target,  # what must hold
    most: int | None = None,  # most candidates, if one of them holds: by default 4, of a size all that are tried
    tried: int = MOST_TRIED,  # most candidates while none holds, and of all with those that lost Gaussians
    best_effort: bool = False,  # answer with the closest candidate if none holds
    on_step: Callable[[Candidate], None] | None = None,  # called with each candidate
    begun: RateResult[Product] | None = None,  # goes on from this result of the same maker, which has started
) -> RateResult[Product]:
    """Search for the best candidate. An interrupted search answers with the best one so far.

    Raises `TargetError` when no candidate holds and `best_effort` is not set; it names the closest one.
    """
    steps: tuple[Candidate, ...] = () if begun is None else begun.steps
    best = None if begun is None else (begun.chosen, begun.product)
    by_size, interrupted = target.limit_bytes is not None, False
    most = most or (tried if by_size else 4)

    def tell(step: Candidate) -> None:
        nonlocal steps
        steps = (*steps, step)
        if on_step:
            on_step(step)

    def ends() -> bool:
        assert best is not None
        # A size is close enough within .3 %.
        close = best[0].holds and best[0].excess > -(0.003 if by_size else maker.close)
        return close or len(steps) >= (most if best[0].holds else tried)

    place: float | None = None
    if begun is None:
        place = _aimed(maker, math.log(maker.start(target)), target)
    elif not ends():
        place = next_place(steps, target)
    try:
        while place is not None:
            step, product = maker.make(math.exp(place), target)
            tell(step)
            if best is None or better(step, best[0], target):
                dropped, best = best, (step, product)
                if dropped is not None:
                    maker.discard(dropped[1])
            else:
                maker.discard(product)
            if ends():
                break
            lost = [] if best[0].holds else lost_views(target, step.measurement)
            seen = bool(lost) and maker.see(lost)
            # The same multiplier has other costs now, so that nothing but a miss of it is known.
            place = place if seen else next_place(steps, target)
        if best is not None and best[0].holds and not by_size:
            best = maker.trim(*best, target, tell, tried - len(steps))
    except KeyboardInterrupt:
        if best is None:
            raise
        LOG.warning("interrupted: the best result so far is taken")
        interrupted = True
    assert best is not None
    chosen, product = best
    if not chosen.holds and not best_effort:
        raise missed(target, chosen)
    return RateResult(product, chosen, chosen.holds, steps, interrupted)


def missed(target: Target, closest: Candidate) -> TargetError:
    """The error to raise if no candidate holds."""
    last = ", with one Gaussian left" if target.limit_bytes is not None and closest.count == 1 else ""
    return TargetError(
        f"{target.describe()} is out of reach; the closest point has {target.report(closest.size, closest.measurement)}"
        f"{last} (--best-effort writes it){obstacle(target, closest)}"
    )


def _aimed(maker: Maker[Product], place: float, target: Target) -> float:
    """Log of the multiplier whose candidate we expect just below the target, found by at most 4 probes, 12 of a size."""
    seen: list[tuple[float, float]] = []
    slope, most = (SLOPE, 4) if target.limit_bytes is None else (SIZE_SLOPE, 12)
    for _ in range(most):
        excess = maker.probe(math.exp(place), target)
        if excess is None or abs(excess - AIM) < -AIM:
            break
        seen.append((place, excess))
        place = next_point(seen, slope, LARGEST_STRIDE)
    return place


def next_place(steps: Sequence[Candidate], target: Target) -> float | None:
    """Log of the multiplier of the next candidate; `None` if another one would not be better, or would be about the same.

    For each candidate in a row that missed we aim 5 % farther below the target.

    `steps`: all so far, at least one. `target`: what must hold.
    """
    by_size = target.limit_bytes is not None
    slope = SIZE_SLOPE if by_size else SLOPE
    misses = next((count for count, step in enumerate(reversed(steps)) if step.holds), len(steps))
    points = [(math.log(step.multiplier), step.excess) for step in steps]
    place = next_point(weighed([(at, excess + 0.05 * misses) for at, excess in points]), slope, LARGEST_STRIDE)
    low, high = _bracket(points, slope)
    place = min(max(place, low), high)
    return place if place > math.log(1e-30) and all(abs(place - at) > 1e-3 for at, _ in points) else None


def _bracket(points: Sequence[tuple[float, float]], slope: float) -> tuple[float, float]:
    """Places between which the answer lies, a little inside of both ends; infinite where none is known.

    One end is the farthest candidate that holds, the other the nearest miss beyond it.
    """
    sign = math.copysign(1.0, slope)
    low = max((sign * at for at, excess in points if excess <= 0.0), default=-math.inf)
    high = min((sign * at for at, excess in points if excess > 0.0 and sign * at > low), default=math.inf)
    away = NEAREST * (high - low) if math.isfinite(high - low) else 0.0
    ends = sign * (low + away), sign * (high - away)
    return min(ends), max(ends)
