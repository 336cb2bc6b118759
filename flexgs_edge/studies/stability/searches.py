"""Experiments on the searches alone, with artificial loss curves: rough, flat, noisy, and targets at the edge of reach."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from flexgs_edge.goals.choice import Choice
from flexgs_edge.goals.line import LINE_STEPS, START, search_line
from flexgs_edge.goals.steps import MAX_PRUNE, Step, better
from flexgs_edge.goals.target import MaxDrop, MaxSize, Measurement, Target
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.methods.best.candidates import Candidate, RateResult
from flexgs_edge.methods.best.effort import EFFORTS
from flexgs_edge.methods.best.grid_search import GridSearch
from flexgs_edge.methods.paper.search import adapt
from flexgs_edge.report.plots import BarChart
from flexgs_edge.studies.experiment import Experiment
from flexgs_edge.studies.result_tables import Cell, Row, Table, columns
from flexgs_edge.studies.stability.breaks import number

COUNT = 100_000
"""Gaussians of the artificial scene."""
GENTLEST = math.log(0.08)
"""Log of the loss if nothing is removed."""
BY_PRUNE, BY_SH = 5.0, 2.0
"""Slopes of the log of the loss over the two rates, as the loss model of the paper's search expects them."""
BY_MULTIPLIER, SIZE_BY_MULTIPLIER = 0.6, -0.45
MIDDLE, BYTES = 1e-4, 500_000
"""The multiplier that loses 1 dB, and the bytes of its file."""
FARTHEST = 1e5
"""At this many times `MIDDLE` nothing is left to remove."""
SEEDS = 5
TOLERATED = 1.01
"""A loss of this many times the limit still counts as met. This covers rounding and is invisible."""
FAR = 0.25
"""A search has failed if it takes this share more bytes than the best possible."""


@dataclass(frozen=True)
class Curve:
    """An artificial curve: loss in dB as a function of the log of a smooth scene's loss.

    Parameters
    ----------
    name : str
        Name in tables.
    loss : callable
        Loss in dB at the log of the smooth loss.
    noise : float
        Standard deviation of the log of a measured loss.
    """

    name: str
    loss: Callable[[float], float]
    noise: float = 0.0

    def measured(self, place: float, seed: int, key: Sequence[int]) -> float:
        """The loss that a search is told, in dB. The same point gives the same loss."""
        if not self.noise:
            return self.loss(place)
        chance = np.random.default_rng([seed, *(k & 0xFFFFFFFF for k in key)]).normal()
        return self.loss(place) * math.exp(self.noise * float(chance))


CURVES = (
    Curve("smooth", math.exp),
    Curve("waves of 10 %", lambda u: math.exp(u) * (1 + 0.1 * math.sin(11 * u))),
    Curve("waves of 30 %", lambda u: math.exp(u) * (1 + 0.3 * math.sin(11 * u))),
    Curve("steps", lambda u: math.exp(0.5 * math.floor(u / 0.5))),
    Curve("nearly flat", lambda u: math.exp(0.1 * u)),
    Curve("cliff", lambda u: 0.3 if u < 0 else 5.0),
    Curve("noise of 4 %", math.exp, 0.04),
    Curve("noise of 20 %", math.exp, 0.2),
)
SMOOTH = CURVES[0]
LIST, LINE, MULTIPLIER = "paper's list", "line of rates", "best's multiplier"


@dataclass(frozen=True)
class World:
    """An artificial scene: a curve and a seed of its noise."""

    curve: Curve
    seed: int = 0

    def size(self, choice: Choice) -> int:
        """Bytes at the paper's bits: 16.5 a Gaussian, 22.5 for its SH."""
        kept, with_sh = COUNT - choice.pruned(COUNT), COUNT - choice.boundary(COUNT)
        return 2048 + kept * 33 // 2 + with_sh * 45 // 2

    def place(self, choice: Choice) -> float:
        """Log of the smooth loss of a choice."""
        return GENTLEST + (BY_PRUNE * choice.prune + BY_SH * choice.sh) / 1000

    def measure(self, choice: Choice) -> Measurement:
        """The measurement that a search gets for a choice."""
        return _measurement(self.curve.measured(self.place(choice), self.seed, (choice.prune, choice.sh)))

    def estimate(self, choice: Choice) -> Measurement:
        """As `measure`, because these scenes have no pixels to leave out."""
        return self.measure(choice)

    def size_at(self, multiplier: float) -> int:
        """Bytes at a multiplier, at least those at `FARTHEST`."""
        return round(BYTES * float(min(multiplier / MIDDLE, FARTHEST) ** SIZE_BY_MULTIPLIER))

    def place_at(self, multiplier: float) -> float:
        """Log of the smooth loss at a multiplier, at least that of the whole scene."""
        return max(BY_MULTIPLIER * math.log(min(multiplier / MIDDLE, FARTHEST)), GENTLEST)

    def measure_at(self, multiplier: float) -> Measurement:
        """The measurement that a search gets for a multiplier."""
        key = (round(1e6 * math.log(multiplier)),)
        return _measurement(self.curve.measured(self.place_at(multiplier), self.seed, key))


def _measurement(drop: float) -> Measurement:
    return Measurement(drop, 42 - 10 * math.log10(max(drop, 1e-9)), drop)


class _Pretended(GridSearch):
    """The search over a multiplier, with an artificial scene in place of rounds of pruning."""

    def __init__(self, world: World, effort: str) -> None:
        nothing: Any = None
        super().__init__(nothing, nothing, nothing, EFFORTS[effort], refit=False)
        self.world = world

    def _start(self, target: Target) -> float:
        return MIDDLE / 3

    def _probe(self, multiplier: float, target: Target) -> float:
        return target.excess(self.world.size_at(multiplier), self.world.measure_at(multiplier))

    def _whole(self, multiplier: float, target: Target) -> tuple[Candidate, GridScene]:
        size, found = self.world.size_at(multiplier), self.world.measure_at(multiplier)
        step = Candidate(multiplier, COUNT, 0, size, found, target.excess(size, found), 0.0)
        return step, cast(GridScene, None)

    # There are no Gaussians that could go.
    def _thinned(self, chosen: Candidate, grid: GridScene, *_: Any) -> tuple[Candidate, GridScene]:
        return chosen, grid

    def _landed_on_quality(self, found: RateResult[GridScene], target: Target) -> RateResult[GridScene]:
        return found


@dataclass(frozen=True)
class Answer:
    """Answer of a search: bytes, true loss, whether it says that the target holds, and number of points measured."""

    size: int
    loss: float
    reached: bool
    steps: int


def by_list(world: World, target: Target, effort: str) -> Answer:
    """Search by the paper's list and refinement."""
    found = adapt(world, target, effort, best_effort=True)
    chosen = found.chosen
    return Answer(chosen.size, world.curve.loss(world.place(chosen.choice)), found.reached, len(found.steps))


def by_line(world: World, target: Target, effort: str) -> Answer:
    """Search along the prune rate, as for formats of other programs."""

    def measure(prune: int) -> Step:
        choice = Choice(prune, 0)
        size, found = world.size(choice), world.measure(choice)
        return Step(choice, size, found, target.excess(size, found), "line", 0.0)

    steps = search_line(measure, target, START, LINE_STEPS[effort])
    chosen = steps[0]
    for step in steps[1:]:
        chosen = step if better(step, chosen, target) else chosen
    return Answer(chosen.size, world.curve.loss(world.place(chosen.choice)), chosen.holds, len(steps))


def by_multiplier(world: World, target: Target, effort: str) -> Answer:
    """Search over the multiplier, as best does."""
    found = _Pretended(world, effort).run(target, best_effort=True)
    multiplier = found.chosen.multiplier
    return Answer(found.chosen.size, world.curve.loss(world.place_at(multiplier)), found.reached, len(found.steps))


SEARCHES: dict[str, Callable[[World, Target, str], Answer]] = {
    LIST: by_list,
    LINE: by_line,
    MULTIPLIER: by_multiplier,
}


def possible(name: str, world: World) -> list[tuple[int, float]]:
    """Bytes and true losses of all points that a search could answer."""
    if name == MULTIPLIER:
        places = [MIDDLE * FARTHEST ** (i / 1000) for i in range(-1000, 1001)]
        return [(world.size_at(m), world.curve.loss(world.place_at(m))) for m in places]
    rates = range(0, MAX_PRUNE + 1, 10)
    choices = [Choice(p, s) for p in rates for s in (range(0, 1001 - p, 20) if name == LIST else (0,))]
    return [(world.size(choice), world.curve.loss(world.place(choice))) for choice in choices]


def targets(name: str) -> dict[str, Target]:
    """Targets in the middle and at the edges of a search's range on the smooth curve."""
    world = World(SMOOTH)
    sizes, losses = zip(*possible(name, world))
    return {
        "1 dB": MaxDrop(1.0),
        "just in reach": MaxDrop(1.02 * min(losses)),
        "just out of reach": MaxDrop(0.9 * min(losses)),
        "everything holds": MaxDrop(2.0 * max(losses)),
        "smallest size": MaxSize(round(1.05 * min(sizes)), "drop"),
        "below the smallest": MaxSize(round(0.9 * min(sizes)), "drop"),
    }


def searches(effort: str) -> Experiment:
    """Run every search on every curve at 1 dB, and on the smooth one at the edges of its range."""
    rows: list[dict[str, Cell]] = []
    for name in SEARCHES:
        at = targets(name)
        for curve in CURVES:
            rows.append(_row(name, curve, "1 dB", at["1 dB"], effort))
        rows += [_row(name, SMOOTH, words, target, effort) for words, target in at.items() if words != "1 dB"]
    table = Table(
        columns(
            search="search",
            curve="curve",
            target="target",
            reached="says it holds",
            possible="can be met",
            steps="points measured",
            more_bytes="bytes beyond the best possible (%)",
            over="true loss over the limit (%)",
            broke="broken by",
        ),
        tuple(rows),
    )
    names = [curve.name for curve in CURVES]
    return Experiment(
        "search",
        "The searches on artificial curves",
        "Three searches over an artificial scene whose loss is a known function of the removed share: smooth, with "
        "waves (more compression may lose less), in steps, nearly flat, with a cliff at the target, and measured "
        f"with noise, as from a sample of tiles (the worst of {SEEDS} draws). A search fails if it takes "
        f"{100 * FAR:g} % more bytes than the best possible, misses a target that can be met, or wrongly says that a "
        "target holds.",
        table,
        BarChart(
            "Bytes beyond the best possible at 1 dB",
            "% (none: the search failed to meet the target)",
            [name.replace(" of ", "\nof ").replace("nearly ", "nearly\n") for name in names],
            {
                search: [
                    None if cell is None else float(cell)
                    for name in names
                    for cell in table.values("more_bytes", search=search, curve=name, target="1 dB")
                ]
                for search in SEARCHES
            },
            limit=100 * FAR,
            digits=0,
        ),
        tuple(_words(rows, name) for name in SEARCHES),
    )


def _row(name: str, curve: Curve, words: str, target: Target, effort: str) -> dict[str, Cell]:
    seeds = range(SEEDS if curve.noise else 1)
    every = [
        _judged(name, World(curve, seed), target, SEARCHES[name](World(curve, seed), target, effort)) for seed in seeds
    ]
    # The worst draw is one that broke, else the one with the most bytes.
    worst = max(every, key=lambda cells: (cells["broke"] is not None, float(cells["more_bytes"] or 0.0)))
    return {"search": name, "curve": curve.name, "target": words, **worst}


def _judged(name: str, world: World, target: Target, answer: Answer) -> dict[str, Cell]:
    limit = target.limit_bytes
    losses = getattr(target, "limit", math.inf)
    if limit is None:
        holding = [size for size, loss in possible(name, world) if loss <= losses]
    else:
        holding = [size for size, _ in possible(name, world) if size <= limit]
    can = bool(holding)
    over = answer.loss / losses - 1 if limit is None else answer.size / limit - 1
    # For a size target, the largest file that fits is the best.
    best = 0 if not can else min(holding) if limit is None else max(holding)
    more = None if not (can and answer.reached) else (answer.size / best - 1) * (1 if limit is None else -1)
    broke = None
    if can and not answer.reached:
        broke = "missed a target that can be met"
    elif answer.reached and over > TOLERATED - 1:
        broke = f"{100 * over:.0f} % over the limit"
    elif more is not None and more > FAR:
        broke = f"{100 * more:.0f} % more bytes"
    return {
        "reached": answer.reached,
        "possible": can,
        "steps": answer.steps,
        "more_bytes": None if more is None else round(100 * more, 1),
        "over": round(100 * over, 1),
        "broke": broke,
    }


def _words(rows: Sequence[Row], name: str) -> str:
    own = [row for row in rows if row["search"] == name]
    broken = [row for row in own if row["broke"] is not None]
    stand = [row for row in own if row["broke"] is None and row["more_bytes"] is not None]
    most = max((number(row, "more_bytes") for row in stand), default=0.0)
    words = ", ".join(f"{row['curve']} at {row['target']} ({row['broke']})" for row in broken)
    return f"{name}: stands on {len(own) - len(broken)} of {len(own)} (at most {most:.0f} % more bytes there)" + (
        f"; fails on {words}." if broken else "."
    )
