"""What a file keeps beside its target: no view breaks, structure stays, and generated poses look alike.

A target is about the mean of the views that decide. The promise adds bounds that a mean would hide: on the worst view, on the
SSIM that is lost, and on generated poses, where no given camera stood. Bounds follow from the target, not from what was reached.
Each is used to a *share*: what was measured over what is allowed. A result holds if no share is above 1.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

from flexgs_edge.errors import InputError
from flexgs_edge.goals.target import Figure, Measurement, Target, log_loss

WORST_TIMES, WORST_MORE = 1.5, 0.2
"""The worst view may lose `WORST_TIMES` times the drop that the target allows in the mean, and `WORST_MORE` dB."""
SSIM_PER_DB = 0.015
"""SSIM that may be lost for each dB of the target. The paper's method loses 0.010 to 0.019 at 1 dB:
docs/results/tuning.md#ssim_per_db"""
LEAST_SSIM = 1e-4  # Least SSIM that a target allows to lose; rounding alone loses a part of it
LOST_ALONE = 1.5  # A view that loses so many times the share of all other bounds needs more than finer steps
MADE_GAP = 3.0
"""Generated poses may have this much less fidelity than the views that decide, dB: twice their squared error."""


class Part(ABC):
    """One bound of the promise."""

    name: str  # what it is about, in two words
    option: str  # the option that moves or lifts it

    @abstractmethod
    def found(self, measurement: Measurement) -> float | None:
        """The figure that it bounds; `None` if it was not measured."""

    @abstractmethod
    def allowed(self, measurement: Measurement) -> float:
        """The bound of that figure."""

    @abstractmethod
    def report(self, measurement: Measurement) -> str:
        """The figure and its bound in words."""

    def share(self, measurement: Measurement) -> float | None:
        """What was measured over what is allowed; `None` if the figure was not measured."""
        found = self.found(measurement)
        return None if found is None else found / self.allowed(measurement)

    def excess(self, measurement: Measurement) -> float | None:
        """Log of the share; `None` if the figure was not measured."""
        share = self.share(measurement)
        return None if share is None else log_loss(share, 1.0)


@dataclass(frozen=True)
class WorstView(Part):
    """No view loses more than `limit` dB. Without a limit, the bound follows the mean: a target for the size allows no drop."""

    figure: Figure
    limit: float | None = None
    name = "worst view"
    option = "--max-worst-drop"

    def __post_init__(self) -> None:
        if self.limit is not None and not (math.isfinite(self.limit) and self.limit > 0.0):
            raise InputError(f"--max-worst-drop {self.limit:g}: expected a drop above 0 dB, or none")

    def found(self, measurement: Measurement) -> float | None:
        return None if measurement.worst is None else measurement.worst.loss(self.figure)

    def allowed(self, measurement: Measurement) -> float:
        return worst_allowed(measurement.usual or 0.0) if self.limit is None else self.limit

    def report(self, measurement: Measurement) -> str:
        found = self.found(measurement)
        return f"worst view {'-' if found is None else f'{found:.3f}'} of {self.allowed(measurement):.3f} dB"


def worst_allowed(drop: float) -> float:
    """The drop of the worst view, dB, that goes with a drop in the mean."""
    return WORST_TIMES * drop + WORST_MORE


@dataclass(frozen=True)
class MeanSsim(Part):
    """The views lose at most `limit` of SSIM in the mean."""

    limit: float
    name = "SSIM lost"
    option = "--max-ssim-drop"

    def __post_init__(self) -> None:
        if not (math.isfinite(self.limit) and 0.0 < self.limit <= 2.0):
            raise InputError(f"--max-ssim-drop {self.limit:g}: expected a number above 0 (0.015 is usual), or none")

    def found(self, measurement: Measurement) -> float | None:
        return measurement.ssim_drop

    def allowed(self, measurement: Measurement) -> float:
        return self.limit

    def report(self, measurement: Measurement) -> str:
        found = measurement.ssim_drop
        return f"SSIM lost {'-' if found is None else f'{found:.4f}'} of {self.limit:.3g}"


@dataclass(frozen=True)
class MadePoses(Part):
    """Generated poses have at most `gap` dB less fidelity than the views that decide."""

    gap: float = MADE_GAP
    name = "made poses"
    option = "--no-views-margin"

    def found(self, measurement: Measurement) -> float | None:
        return measurement.made_gap

    def allowed(self, measurement: Measurement) -> float:
        return self.gap

    def report(self, measurement: Measurement) -> str:
        found = measurement.made_gap
        return f"made poses {'-' if found is None else f'{found:.2f}'} of {self.gap:g} dB less fidelity"


@dataclass(frozen=True)
class Promised:
    """A target, and the parts of the promise that hold with it.

    With a size target the size alone says whether a point holds; of those that fit, one that keeps the promise is better.
    """

    target: Target  # what the user asked for
    parts: tuple[Part, ...]  # the other bounds

    @property
    def figure(self) -> Figure:
        """The figure of the target."""
        return self.target.figure

    @property
    def limit_bytes(self) -> int | None:
        """The size limit of the target."""
        return self.target.limit_bytes

    def excess(self, size: int, measurement: Measurement | None) -> float:
        own = self.target.excess(size, measurement)
        return own if self.limit_bytes is not None or measurement is None else max(own, self.broken(measurement))

    def broken(self, measurement: Measurement | None) -> float:
        """The largest excess of the parts; zero or less if all of them hold or none was measured."""
        found = () if measurement is None else (part.excess(measurement) for part in self.parts)
        return max((excess for excess in found if excess is not None), default=-math.inf)

    def decides(self, size: int, measurement: Measurement) -> Part | None:
        """The part that is nearest to its bound or farthest beyond; `None` if that is the target itself."""
        own = self.target.excess(size, measurement)
        found = [(part.excess(measurement), part) for part in self.parts]
        known = [(excess, part) for excess, part in found if excess is not None]
        excess, part = max(known, key=lambda pair: pair[0], default=(-math.inf, None))
        return part if excess > own else None

    def describe(self) -> str:
        return self.target.describe()

    def report(self, size: int, measurement: Measurement | None) -> str:
        found = self.target.report(size, measurement)
        if measurement is None:
            return found
        known = [part for part in self.parts if part.found(measurement) is not None]
        return ", ".join([found, *(part.report(measurement) for part in known)])


def by_quality(target: Target, measurement: Measurement) -> tuple[bool, float]:
    """An order of results of one size, the best first: what breaks no bound that the user set, then what loses least.

    Other bounds follow from what a result itself loses. So a worst view counts as the mean loss that would allow it: a
    result with one bad view may still be far better than one that loses much everywhere.
    """
    broken, loss = False, measurement.loss(target.figure)
    for part in target.parts if isinstance(target, Promised) else ():
        found = part.found(measurement)
        if isinstance(part, WorstView) and found is not None:
            broken |= part.limit is not None and found > part.limit
            loss = max(loss, (found - WORST_MORE) / WORST_TIMES)
    return broken, loss


def mean_alone(target: Target) -> Target:
    """The target without the promise. Rough estimates aim by it: a worst view is too noisy, SSIM too slow for them."""
    return target.target if isinstance(target, Promised) else target


def means(target: Target) -> Target:
    """The target with those parts of the promise that are means over the views, which a first guess can tell."""
    return promised(mean_alone(target), _ssim_parts(target))


def excesses(target: Target, size: int, measurement: Measurement) -> list[float]:
    """The excess of a target by itself, then those of the parts of the promise that were measured."""
    own = mean_alone(target).excess(size, measurement)
    parts = target.parts if isinstance(target, Promised) else ()
    found = (part.excess(measurement) for part in parts)
    return [own, *(excess for excess in found if excess is not None)]


def lost_views(target: Target, measurement: Measurement) -> list[int]:
    """Places, among the views that decide, of those that lose too much while all else is far nearer to what is allowed.

    A finer result alone would mend them at the cost of all others. With a target for the size there are none.
    """
    if not isinstance(target, Promised) or target.limit_bytes is not None:
        return []
    others = [part.share(measurement) for part in target.parts if not isinstance(part, WorstView)]
    most = max(math.exp(target.target.excess(0, measurement)), *(share for share in others if share is not None), 0.0)
    bounds = [part.allowed(measurement) for part in target.parts if isinstance(part, WorstView)]
    return [
        place
        for place, loss in enumerate(measurement.losses)
        if loss is not None and any(loss > max(1.0, LOST_ALONE * most) * bound for bound in bounds)
    ]


def bounds_ssim(target: Target) -> bool:
    """Whether SSIM is among the parts of the promise."""
    return bool(_ssim_parts(target))


def _ssim_parts(target: Target) -> list[Part]:
    parts = target.parts if isinstance(target, Promised) else ()
    return [part for part in parts if isinstance(part, MeanSsim)]


def in_the_way(target: Target, size: int, measurement: Measurement | None) -> str:
    """A sentence on the part of the promise that a point misses by most, and what would lift it; empty if there is none."""
    if not isinstance(target, Promised) or measurement is None:
        return ""
    part = target.decides(size, measurement)
    if part is None or (part.excess(measurement) or 0.0) <= 0.0:
        return ""
    return f"the {part.name} stands in the way: {part.report(measurement)}; {lifting(part, measurement)}"


def lifting(part: Part, measurement: Measurement) -> str:
    """What the user may say to move or lift a part, in words."""
    found = part.found(measurement)
    if isinstance(part, MadePoses) or found is None:
        return f"{part.option} lifts it"
    digits = 1 if isinstance(part, WorstView) else 3
    enough = math.ceil(found * 10**digits - 1e-6) / 10**digits
    return f"{part.option} {enough:g} would allow this point, {part.option} none lifts it"


def promised(target: Target, parts: Sequence[Part]) -> Target:
    """`target` with the parts; the target itself if there are none."""
    return Promised(target, tuple(parts)) if parts else target


@dataclass(frozen=True)
class KeptPart:
    """How a part of the promise stands at a measured point.

    `found`, `allowed`: the figure, `None` if it was not measured, and its bound.
    """

    name: str  # `worst view`, `SSIM lost` or `made poses`
    words: str  # the figure and its bound in words
    found: float | None
    allowed: float
    share: float | None  # the figure over its bound
    held: bool  # whether the bound holds; True for a figure that was not measured


@dataclass(frozen=True)
class KeptPromise:
    """How the promise stands at a measured point."""

    parts: tuple[KeptPart, ...]  # in the order of the promise
    decided: str  # name of the part of which the largest share is used, or `target`
    share: float  # the largest share of all, the target's included

    @property
    def held(self) -> bool:
        """Whether all parts hold."""
        return all(part.held for part in self.parts)


def kept_promise(target: Target | None, size: int, measurement: Measurement | None) -> KeptPromise | None:
    """How the promise stands; `None` if there is none, or nothing was measured."""
    if not isinstance(target, Promised) or measurement is None:
        return None
    decides = target.decides(size, measurement)
    return KeptPromise(
        tuple(
            KeptPart(
                part.name,
                part.report(measurement),
                part.found(measurement),
                part.allowed(measurement),
                part.share(measurement),
                (part.excess(measurement) or 0.0) <= 0.0,
            )
            for part in target.parts
        ),
        "target" if decides is None else decides.name,
        math.exp(max(excesses(target, size, measurement))),
    )
