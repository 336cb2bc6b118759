"""Fast online adaptation (FOA): finds the strongest compression that meets a target, in a counted number of steps.

A point is a choice of prune rate p and SH rate s.

1. *List.* We sort the paper's list of points by exact bytes and start at (.4, .4). While the target holds, we go on to
   fewer bytes. Otherwise we go to more bytes, up to the first point that holds.
2. *Refinement.* Around that point p and s move on a grid of 0.02 within +-0.1. Bytes are exact and free, so only points
   with fewer bytes than the best are of interest. A local model of the loss (log-linear in p and s) is fitted to the
   points measured so far. Each step measures the smallest point that the model expects to hold. A point that fails rules
   out all points with both rates at least as high.
3. *Confirmation.* Both stages look at estimates, from a part of the pixels. At the first point we also measure in full,
   to learn how far estimates are off. The answer is measured in full too. If it does not hold, we try the next point that
   should. So every answer was itself measured to hold.

Steps are counted and never timed, and the model adds plain Python floats in a fixed order. So the same command gives the
same bytes.
"""

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol

from flexgs_edge.goals.steps import MAX_PRUNE, REFINE_STEPS, Choice, Phase, SearchResult, Step, out_of_reach
from flexgs_edge.goals.target import Measurement, Target

PRIOR_SLOPES = (5.0, 2.0)
"""Excess (log of loss over limit) for each unit of prune rate and SH rate, before anything is measured:
docs/results/tuning.md#prior_slopes"""
PRIOR_WEIGHT = 1e-3
"""Weight of the prior slopes, in measured points at the limit. They decide only where points leave a slope open."""
WIDTH = 0.5
"""Excess at which a measured point weighs 1/e of one at the limit, because the model need only be right near the limit."""
CANDIDATES: tuple[tuple[int, int], ...] = (
    (2, 3), (1, 5), (2, 4), (3, 3), (1, 6), (2, 5), (3, 4), (4, 3), (2, 6), (3, 5),
    (4, 4), (3, 6), (4, 5), (5, 4), (6, 3), (5, 5), (6, 4), (7, 3), (8, 2), (9, 1),
)  # fmt: skip
"""The paper's list of (p, s), in tenths, as published. It is not sorted by bytes; the search sorts it."""
START = (4, 4)  # Where the walk along the list begins, in tenths
GRID = 20  # Step of the refinement in p and s, in thousandths
REACH = 100  # Largest distance of the refinement from the list's answer, in thousandths


@dataclass(frozen=True)
class LossModel:
    """excess = constant + prune * p + sh * s, with prune rate p and SH rate s in 0..1."""

    constant: float
    prune: float
    sh: float

    @classmethod
    def fit(cls, points: list[tuple[Choice, float]]) -> "LossModel":
        """Fit `points` by weighted least squares; the prior slopes decide where points leave a direction open.

        Slopes stay at or above zero, because more compression never gains quality.
        """
        rows = [(c.prune / 1000.0, c.sh / 1000.0, e, math.exp(-min(abs(e) / WIDTH, 6.0))) for c, e in points]
        weight = math.fsum(w for *_, w in rows)
        mean_p = math.fsum(w * p for p, _, _, w in rows) / weight
        mean_s = math.fsum(w * s for _, s, _, w in rows) / weight
        mean_e = math.fsum(w * e for _, _, e, w in rows) / weight
        pp = PRIOR_WEIGHT + math.fsum(w * (p - mean_p) ** 2 for p, _, _, w in rows)
        ss = PRIOR_WEIGHT + math.fsum(w * (s - mean_s) ** 2 for _, s, _, w in rows)
        ps = math.fsum(w * (p - mean_p) * (s - mean_s) for p, s, _, w in rows)
        pe = PRIOR_WEIGHT * PRIOR_SLOPES[0] + math.fsum(w * (p - mean_p) * (e - mean_e) for p, _, e, w in rows)
        se = PRIOR_WEIGHT * PRIOR_SLOPES[1] + math.fsum(w * (s - mean_s) * (e - mean_e) for _, s, e, w in rows)
        determinant = pp * ss - ps * ps
        slope_p = max((pe * ss - se * ps) / determinant, 0.0)
        slope_s = max((se * pp - pe * ps) / determinant, 0.0)
        return cls(mean_e - slope_p * mean_p - slope_s * mean_s, slope_p, slope_s)

    def predict(self, choice: Choice) -> float:
        """Expected excess at `choice`."""
        return self.constant + (self.prune * choice.prune + self.sh * choice.sh) / 1000.0


class Evaluator(Protocol):
    """The questions that a search may ask about a scene."""

    def size(self, choice: Choice) -> int:
        """Exact bytes of the file at this choice. This must be cheap."""

    def measure(self, choice: Choice) -> Measurement:
        """Prune, quantize, dequantize, render and compare. This is the costly question."""

    def estimate(self, choice: Choice) -> Measurement:
        """As `measure`, from a part of the pixels, in less time."""


def adapt(
    evaluator: Evaluator,  # Answers for sizes, estimates and measurements. No question is asked twice.
    target: Target,  # what must hold
    effort: str = "balanced",  # Number of refinement steps (`REFINE_STEPS`). Default: `balanced`.
    best_effort: bool = False,  # return the closest point with `reached` False when nothing holds
    on_step: Callable[[Step], None] | None = None,  # called after each new step
    rows: int | None = None,  # rows of the scene; an error then says if one Gaussian is left
) -> SearchResult:
    """Find the choice that meets `target` with the fewest bytes (for a size target: with the best quality).

    Raises `TargetError` when no point holds and `best_effort` is not set; the message names the closest point.
    """
    search = _Search(evaluator, target, on_step)
    refine_steps = REFINE_STEPS[effort]
    if target.limit_bytes is None:
        chosen = _search_quality(search, refine_steps)
    else:
        chosen = _search_size(search, target.limit_bytes, refine_steps)
    chosen = _confirmed(search, chosen)
    if not chosen.holds and not best_effort:
        raise out_of_reach(target, chosen, rows)
    return SearchResult(chosen, chosen.holds, tuple(search.steps))


def measure_fixed(evaluator: Evaluator, choice: Choice, target: Target | None = None) -> SearchResult:
    """The result of a run with fixed rates: one step, no search. `reached` says whether `target` holds, if there is one."""
    started = time.perf_counter()
    size, measurement = evaluator.size(choice), evaluator.measure(choice)
    excess = 0.0 if target is None else target.excess(size, measurement)
    step = Step(choice, size, measurement, excess, "fixed", time.perf_counter() - started)
    return SearchResult(step, step.holds, (step,))


class _Search:
    """Asks the evaluator, remembers every answer and logs the steps."""

    def __init__(self, evaluator: Evaluator, target: Target, on_step: Callable[[Step], None] | None) -> None:
        self.evaluator = evaluator
        self.target = target
        self.on_step = on_step
        self.steps: list[Step] = []
        self._known: dict[Choice, Step] = {}
        self._confirmed: dict[Choice, Step] = {}
        self._sizes: dict[Choice, int] = {}
        self._off = 0.0
        self._has_sh = self.size(Choice(0, 0)) != self.size(Choice(0, 1000))

    def distinct(self, choices: Iterable[Choice]) -> list[Choice]:
        """The choices without those that are others by name only: a scene without SH has no SH rates."""
        return list(dict.fromkeys(choice if self._has_sh else Choice(choice.prune, 0) for choice in choices))

    def size(self, choice: Choice) -> int:
        if choice not in self._sizes:
            self._sizes[choice] = self.evaluator.size(choice)
        return self._sizes[choice]

    def known(self, choice: Choice) -> bool:
        return choice in self._known

    def estimate(self, choice: Choice, phase: Phase) -> Step:
        """Estimate a choice. The first one is also measured in full, to learn how far estimates are off."""
        if choice not in self._known:
            first = not self._known
            started = time.perf_counter()
            measurement = self.evaluator.estimate(choice)
            excess = self.target.excess(self.size(choice), measurement)
            if first and self.target.limit_bytes is None:
                off = self.confirm(choice).excess - excess
                self._off = off if math.isfinite(off) else 0.0  # identical renders have no finite distance
            seconds = time.perf_counter() - started
            step = Step(choice, self.size(choice), measurement, excess + self._off, phase, seconds, estimated=True)
            self._known[choice] = step
            self._tell(step)
        return self._known[choice]

    def confirm(self, choice: Choice) -> Step:
        """Measure a choice in full."""
        if choice not in self._confirmed:
            started = time.perf_counter()
            measurement = self.evaluator.measure(choice)
            excess = self.target.excess(self.size(choice), measurement)
            step = Step(choice, self.size(choice), measurement, excess, "confirm", time.perf_counter() - started)
            self._confirmed[choice] = step
            self._tell(step)
        return self._confirmed[choice]

    def _tell(self, step: Step) -> None:
        self.steps.append(step)
        if self.on_step:
            self.on_step(step)

    @property
    def estimates(self) -> list[Step]:
        """The estimated steps, in order."""
        return list(self._known.values())

    def unconfirmed(self) -> list[Step]:
        """Steps that were only estimated: first those that hold, by bytes, then the others, by how far they miss."""
        steps = [step for choice, step in self._known.items() if choice not in self._confirmed]
        return sorted(steps, key=lambda step: (max(step.excess, 0.0), step.size))

    def closest(self) -> Step:
        """The step that misses by least, among those measured in full."""
        return min(self._confirmed.values(), key=lambda step: (step.excess, step.size))

    def by_size(self, choices: list[Choice]) -> list[Choice]:
        """Choices from most to fewest bytes. Ties go by rates, so that the order is unique."""
        return sorted(choices, key=lambda choice: (-self.size(choice), choice.prune, choice.sh))


def _confirmed(search: _Search, chosen: Step) -> Step:
    """Measure `chosen` in full. While that does not hold, try the next step that should, given how far the estimate was off."""
    full = search.confirm(chosen.choice)
    while not full.holds:
        off = max(full.excess - chosen.excess, 0.0)
        # If the estimate already missed the target, all other steps miss by more.
        rest = [step for step in search.unconfirmed() if step.excess + off <= 0.0]
        if not rest:
            return search.closest()
        chosen = rest[0]
        full = search.confirm(chosen.choice)
    return full


def _candidates(search: _Search) -> list[Choice]:
    return search.by_size(search.distinct(Choice(100 * p, 100 * s) for p, s in CANDIDATES))


def _search_quality(search: _Search, refine_steps: int) -> Step:
    candidates = _candidates(search)
    (start,) = search.distinct([Choice(100 * START[0], 100 * START[1])])
    at = candidates.index(start)
    best = search.estimate(candidates[at], "list")
    if best.holds:
        for choice in candidates[at + 1 :]:
            step = search.estimate(choice, "list")
            if not step.holds:
                break
            best = step
    else:
        for choice in reversed(candidates[:at]):
            best = search.estimate(choice, "list")
            if best.holds:
                break
    gentlest = best.choice == candidates[0]
    box = search.distinct(_box(best.choice, to_zero=gentlest))
    if not best.holds:
        # The whole list fails: only the gentlest point can still hold, and it is the closest if it does not.
        best = search.estimate(Choice(0, 0), "refine")
        refine_steps -= 1
        if not best.holds:
            return min(search.estimates, key=lambda step: (step.excess, step.size))
    return _refine(search, best, box, refine_steps)


def _refine(search: _Search, best: Step, box: list[Choice], steps: int) -> Step:
    """Walk from `best` towards fewer bytes inside `box`, measuring at most `steps` new points."""
    for _ in range(steps):
        failed = [step.choice for step in search.estimates if not step.holds]
        open_points = [
            choice
            for choice in box
            if search.size(choice) < best.size
            and not search.known(choice)
            # A point with rates at least as high as those of one that failed would fail too.
            and not any(choice.prune >= other.prune and choice.sh >= other.sh for other in failed)
        ]
        if not open_points:
            break
        model = LossModel.fit([(step.choice, step.excess) for step in search.estimates])
        expected = [choice for choice in open_points if model.predict(choice) <= 0.0]
        if expected:
            probe = search.by_size(expected)[-1]
        else:  # none is expected to hold: try the likeliest one, because the model may be wrong
            probe = min(open_points, key=lambda choice: (model.predict(choice), search.size(choice), choice.prune))
        step = search.estimate(probe, "refine")
        if step.holds and step.size < best.size:
            best = step
    return best


def _search_size(search: _Search, limit: int, refine_steps: int) -> Step:
    """The best quality that fits. Sizes are free, so we measure only points just below the limit."""
    if search.size(Choice(0, 0)) <= limit:
        return search.estimate(Choice(0, 0), "list")
    candidates = _candidates(search)
    fitting = [choice for choice in candidates if search.size(choice) <= limit]
    answer = fitting[0] if fitting else candidates[-1]
    box = search.distinct(_box(answer, to_zero=answer == candidates[0]))
    edge = _edge(search, [choice for choice in box if search.size(choice) <= limit])
    if fitting:
        search.estimate(answer, "list")
    if not edge:
        smallest = search.by_size(box)[-1]
        return search.estimate(smallest, "refine")
    judge = search.target.figure

    def loss(step: Step) -> tuple[float, int]:
        assert step.measurement is not None
        return step.measurement.loss(judge), step.size

    # Hill climbing along the edge (one point for each p), from the list's answer outwards.
    at = min(range(len(edge)), key=lambda i: (abs(edge[i].prune - answer.prune), i))
    best = search.estimate(edge[at], "refine")
    left = refine_steps - 1
    for direction in (-1, 1):
        i = at + direction
        while 0 <= i < len(edge) and left > 0:
            step = search.estimate(edge[i], "refine")
            left -= 1
            if loss(step) >= loss(best):
                break
            best, i = step, i + direction
    return min((step for step in search.estimates if step.holds), key=loss)


def _edge(search: _Search, fitting: list[Choice]) -> list[Choice]:
    """The fitting choice with the most bytes for each prune rate, in order of prune rate."""
    largest: dict[int, Choice] = {}
    for choice in reversed(search.by_size(fitting)):
        largest[choice.prune] = choice
    return [largest[prune] for prune in sorted(largest)]


def _box(centre: Choice, to_zero: bool) -> list[Choice]:
    """Grid points within `REACH` of `centre`. With `to_zero`, also all points with lower rates."""

    def line(value: int, top: int) -> range:
        # The grid passes through `centre`, so it need not pass through zero.
        low = value % GRID if to_zero else max(value - REACH, value % GRID)
        return range(low, min(value + REACH, top) + 1, GRID)

    return [Choice(p, s) for p in line(centre.prune, MAX_PRUNE) for s in line(centre.sh, 1000) if p + s <= 1000]
