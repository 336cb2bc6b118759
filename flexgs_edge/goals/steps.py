"""The points that a search measured, its answer, and the order of two points."""

from dataclasses import dataclass
from typing import Literal, Protocol

from flexgs_edge.errors import InputError, TargetError
from flexgs_edge.goals.promise import by_quality, in_the_way
from flexgs_edge.goals.target import Measurement, Target

MAX_PRUNE = 980  # Largest prune rate of the refinement, in thousandths; something must be left to draw
REFINE_STEPS = {"fast": 4, "balanced": 10, "max": 10}  # Measured points of the refinement for each `--effort`


@dataclass(frozen=True, order=True)
class Choice:
    """How much to prune, in thousandths of the N rows."""

    prune: int  # share of the rows that is removed (the paper's p)
    sh: int  # share of the rows that loses its SH above degree 0 (the paper's s)

    def __post_init__(self) -> None:
        if self.prune < 0 or self.sh < 0 or self.prune + self.sh > 1000:
            raise InputError(
                f"prune rate {self.prune / 1000} and SH rate {self.sh / 1000}: "
                "expected rates from 0 to 1 that add up to at most 1"
            )

    @classmethod
    def from_rates(cls, prune: float, sh: float) -> "Choice":
        """A choice from shares between 0 and 1, rounded to thousandths.

        >>> Choice.from_rates(0.4, 0.3)
        Choice(prune=400, sh=300)
        """
        if not (0 <= prune <= 1 and 0 <= sh <= 1):
            raise InputError(
                f"prune rate {prune} and SH rate {sh}: expected rates from 0 to 1 that add up to at most 1"
            )
        return cls(round(prune * 1000), round(sh * 1000))

    def pruned(self, count: int) -> int:
        """Number of rows removed from a scene of `count` rows."""
        return count * self.prune // 1000

    def boundary(self, count: int) -> int:
        """Rank below which a row has lost its SH, or is removed."""
        return count * (self.prune + self.sh) // 1000


Phase = Literal["list", "refine", "confirm", "fixed", "multiplier"]


@dataclass(frozen=True)
class Step:
    """One point of a search."""

    choice: Choice  # prune rate and SH rate, in thousandths
    size: int  # exact bytes of the file
    measurement: Measurement | None  # quality; `None` if size alone decided
    excess: float  # by how much the point misses the target; zero or less holds
    phase: Phase  # part of the search that asked for the point
    seconds: float  # wall time of the measurement
    # `measurement` comes from a part of the pixels, and `excess` is an estimate for all of them.
    estimated: bool = False

    @property
    def holds(self) -> bool:
        """Whether the target holds at this point."""
        return self.excess <= 0.0


@dataclass(frozen=True)
class Scored:
    """The camera poses that a search by measured costs has scored."""

    poses: int  # scored poses
    made: int  # generated poses among them (`--views-margin`)
    unseen: int  # Gaussians that could show, but that no scored pose sees


@dataclass(frozen=True)
class SearchResult:
    """The answer of a search, and the points on the way to it."""

    chosen: Step  # the point to write
    reached: bool  # the target holds at `chosen`; only `--best-effort` accepts a point that misses
    steps: tuple[Step, ...]  # all points, in order
    scored: Scored | None = None  # the poses behind the scores; `None` for searches that are given scores


class Point(Protocol):
    """A measured point of any kind of search."""

    @property
    def size(self) -> int:
        """Bytes of the file."""

    @property
    def measurement(self) -> Measurement | None:
        """Quality."""

    @property
    def excess(self) -> float:
        """By how much the point misses the target; zero or less holds."""

    @property
    def holds(self) -> bool:
        """Whether the target holds at this point."""


def better(step: Point, other: Point, target: Target) -> bool:
    """Whether `step` is the better answer: one that holds, then the smaller file.

    For a size target, of two that hold: see `by_quality`.
    """
    if step.holds != other.holds:
        return step.holds
    if not step.holds:
        return step.excess < other.excess
    if target.limit_bytes is not None and step.measurement is not None and other.measurement is not None:
        return by_quality(target, step.measurement) < by_quality(target, other.measurement)
    return step.size < other.size


def step_words(step: Step, target: Target | None) -> str:
    """One line about a step of a search."""
    figure = target.report(step.size, step.measurement) if target else ""
    figure += " (estimated)" if step.estimated else ""
    return f"{step.phase}: prune {step.choice.prune / 1000:g}, SH {step.choice.sh / 1000:g}: {figure}, {step.seconds:.1f} s"


def out_of_reach(target: Target, closest: Step, rows: int | None = None) -> TargetError:
    """The error to raise if no point holds; it names the closest point, and says if a scene of `rows` has one Gaussian there."""
    last = ""
    if rows is not None and target.limit_bytes is not None and rows - closest.choice.pruned(rows) == 1:
        last = ", with one Gaussian left"
    return TargetError(
        f"{target.describe()} cannot be reached: the closest point is {target.report(closest.size, closest.measurement)} "
        f"(prune rate {closest.choice.prune / 1000:g}, SH rate {closest.choice.sh / 1000:g}{last}); "
        f"relax the target, or take that point with --best-effort{obstacle(target, closest)}"
    )


def obstacle(target: Target, closest: Point) -> str:
    """What of the promise stands in the way at the closest point, to end a message with; empty if the target itself does."""
    words = in_the_way(target, closest.size, closest.measurement)
    return words and f". Of the promise, {words}"
