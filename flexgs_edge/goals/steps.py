"""What a search has seen: the points it measured, its answer, and which of two points is better."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

from flexgs_edge.errors import TargetError
from flexgs_edge.goals.choice import Choice
from flexgs_edge.goals.target import Measurement, Target

Phase = Literal["list", "refine", "confirm", "fixed", "line", "multiplier"]
MAX_PRUNE = 980
"""Largest prune rate of the refinement, in thousandths: something must be left to draw."""
REFINE_STEPS = {"fast": 4, "balanced": 10, "thorough": 32}
"""Measured steps of the refinement at each `--effort`."""


@dataclass(frozen=True)
class Step:
    """One point that the search looked at.

    Parameters
    ----------
    choice : Choice
        Prune rate and SH rate, thousandths.
    size : int
        Exact bytes of the file.
    measurement : Measurement or None
        Quality; `None` where size alone decided.
    excess : float
        By how much the target was missed; zero or less holds.
    phase : {"list", "refine", "confirm", "fixed", "line", "multiplier"}
        Part of the search that asked.
    seconds : float
        Wall time of the step.
    estimated : bool
        `measurement` is an estimate from a part of the pixels, and `excess` what a full one is expected to show.
    """

    choice: Choice
    size: int
    measurement: Measurement | None
    excess: float
    phase: Phase
    seconds: float
    estimated: bool = False

    @property
    def holds(self) -> bool:
        """The target holds here."""
        return self.excess <= 0.0


@dataclass(frozen=True)
class Scored:
    """What a search by measured costs looked at.

    Parameters
    ----------
    poses : int
        Scored poses.
    made : int
        How many of them nobody took (`--views-margin`).
    unseen : int
        Gaussians that can show at all, but in none of them.
    """

    poses: int
    made: int
    unseen: int


@dataclass(frozen=True)
class SearchResult:
    """The answer of a search and the way to it.

    Parameters
    ----------
    chosen : Step
        The point to write.
    reached : bool
        The target holds at `chosen` (always, unless the best effort was asked for).
    steps : tuple of Step
        Every step, in order.
    scored : Scored or None
        What it was told by; `None` for searches that are given scores.
    """

    chosen: Step
    reached: bool
    steps: tuple[Step, ...]
    scored: Scored | None = None


class Point(Protocol):
    """A measured point of any search."""

    @property
    def size(self) -> int:
        """Bytes of the file."""

    @property
    def measurement(self) -> Measurement | None:
        """Quality."""

    @property
    def excess(self) -> float:
        """By how much the target was missed."""

    @property
    def holds(self) -> bool:
        """The target holds here."""


def better(step: Point, other: Point, target: Target) -> bool:
    """Whether `step` is the better answer: holding before missing, then fewer bytes (a size target: less loss)."""
    if step.holds != other.holds:
        return step.holds
    if not step.holds:
        return step.excess < other.excess
    if target.limit_bytes is not None and step.measurement is not None and other.measurement is not None:
        return step.measurement.loss(target.figure) < other.measurement.loss(target.figure)
    return step.size < other.size


def step_words(step: Step, target: Target | None) -> str:
    """A step of a search in a line."""
    figure = target.report(step.size, step.measurement) if target else ""
    figure += " (estimated)" if step.estimated else ""
    return f"{step.phase}: prune {step.choice.prune / 1000:g}, SH {step.choice.sh / 1000:g}: {figure}, {step.seconds:.1f} s"


def out_of_reach(target: Target, closest: Step) -> TargetError:
    """The error when nothing holds, with the closest point."""
    return TargetError(
        f"{target.describe()} cannot be reached: the closest point is {target.report(closest.size, closest.measurement)} "
        f"(prune rate {closest.choice.prune / 1000:g}, SH rate {closest.choice.sh / 1000:g}); "
        f"relax the target, or take that point with --best-effort"
    )
