"""Ablations of the method `best`: rounds and searches that replace one part and leave the rest as it is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import numpy as np

from flexgs_edge.methods.best.allocation import REMOVAL_FACTOR, SH_FACTOR, BitModel
from flexgs_edge.methods.best.costs import RemovalCosts
from flexgs_edge.methods.best.grid_maker import GridMaker
from flexgs_edge.methods.best.rounds import PruneRounds
from flexgs_edge.methods.best.snapshot import Snapshot
from flexgs_edge.methods.paper.prune import ranks_from_order
from flexgs_edge.studies.rate.descent_parts import DESCENT_PARTS


class RankedPath(PruneRounds):
    """Rounds that remove rows in the order of a score instead of by measured costs.

    Measured costs are handed out again by rank: the row with the lowest score gets the lowest cost. So a multiplier
    removes about as many rows as it would by measured costs.

    `order`: [N] i64, rows of the scene, least important first.
    """

    def __init__(self, *words: Any, order: np.ndarray, **more: Any) -> None:
        super().__init__(*words, **more)
        self._ranks = ranks_from_order(order)
        self._hand_out(self.snapshots[0])

    def descend(self, share: float) -> Snapshot:
        """See `PruneRounds.descend`."""
        self._hand_out(super().descend(share))
        return self.snapshots[-1]

    def _hand_out(self, snapshot: Snapshot) -> None:
        costs = snapshot.costs
        # Rows that no pose sees have no cost, so they stay out of this.
        seen = np.flatnonzero(costs.weight2 > 0)
        removal = costs.removal.copy()
        removal[seen[np.argsort(self._ranks[self.rows[snapshot.rows[seen]]])]] = np.sort(removal[seen])
        snapshot.costs = replace(costs, removal=removal)


class OnePassPath(PruneRounds):
    """Rounds that keep the costs of the first pass over the whole scene. Colours are refitted in each round as usual."""

    def descend(self, share: float) -> Snapshot:
        """See `PruneRounds.descend`."""
        last = self.snapshots[-1]
        snapshot = super().descend(share)
        kept = np.searchsorted(last.rows, snapshot.rows)
        # Weights and mean colours must fit the refitted colours, so these stay as measured now.
        snapshot.costs = replace(snapshot.costs, removal=last.costs.removal[kept], sh=last.costs.sh[:, kept])
        return snapshot


class SomeDegrees(GridMaker):
    """A search with fewer SH degrees to choose from; a subclass says which."""

    with_none: ClassVar[bool]

    def choose(self, costs: RemovalCosts, bits: BitModel, multiplier: float) -> tuple[np.ndarray, np.ndarray]:
        """See `GridMaker.choose`."""
        top = len(costs.sh)
        return choose_among(costs, bits, multiplier, (0, top) if self.with_none else (top,))


class AllOrNone(SomeDegrees):
    """A search that gives each Gaussian all SH or none."""

    with_none = True


class FullSh(SomeDegrees):
    """A search that gives all SH to every Gaussian that some pose sees."""

    with_none = False


def choose_among(
    costs: RemovalCosts, bits: BitModel, multiplier: float, degrees: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    """As `flexgs_edge.methods.best.allocation.choose`, but with only `degrees` to choose from."""
    top = len(costs.sh)
    lagrangian = np.array(
        [
            (SH_FACTOR * costs.sh[degree] if degree < top else np.zeros_like(costs.removal))
            + multiplier * bits.of_degree(degree)
            for degree in degrees
        ]
    )
    chosen = np.array(degrees, np.uint8)[lagrangian.argmin(axis=0)]
    keep = REMOVAL_FACTOR * costs.removal >= lagrangian.min(axis=0)
    unseen = costs.weight2 <= 0
    keep[unseen] = True
    chosen[unseen] = 0
    return keep, chosen


@dataclass(frozen=True)
class Variant:
    """The method `best`, or the same without one part."""

    name: str  # name in tables
    words: str  # what replaces the part, for tables
    search: type[GridMaker] = GridMaker  # the search, a `GridMaker`
    path: Callable[..., PruneRounds] = PruneRounds  # makes the rounds from the arguments of `PruneRounds`
    refit: bool = True  # as for `compress`
    distil: int | None = None  # As for `compress`. Default: as the study has it.


WHOLE = Variant("whole", "nothing is taken away")


def parts_of(order: np.ndarray, sh_degree: int, descends: bool) -> tuple[Variant, ...]:
    """Variants that each lack one part. Those about SH are left out if the scene has none.

    `order`: [N] i64, rows by the paper's score, least important first. `sh_degree`: SH degree of the scene. `descends`:
    whether the searches descend: then variants lack parts of the descents, too.
    """
    parts = [
        Variant(
            "gs ranks",
            "Gaussians are removed in the order of the paper's score gs, ranked once, instead of by measured costs",
            path=partial(RankedPath, order=order),
        ),
        Variant(
            "one pass", "costs of one pass over the whole scene, not measured again after removals", path=OnePassPath
        ),
        Variant("no refit", "colours are not refitted (--no-refit)", refit=False),
    ]
    if sh_degree:
        parts += [
            Variant("SH all or none", "each Gaussian keeps all SH or none", search=AllOrNone),
            Variant("full SH", "every Gaussian keeps all SH", search=FullSh),
        ]
    if descends:
        parts.append(Variant("no descents", "colours are refitted instead of descents (--distil 0)", distil=0))
        parts += [Variant(name, words, search=search) for name, words, search in DESCENT_PARTS]
    return tuple(parts)
