"""The measured method with one part taken away: paths and searches that replace that part and leave the rest as it is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import numpy as np

from flexgs_edge.methods.best.allocation import REMOVAL_FACTOR, SH_FACTOR, BitModel
from flexgs_edge.methods.best.costs import RemovalCosts
from flexgs_edge.methods.best.grid_search import GridSearch
from flexgs_edge.methods.best.rounds import PruneRounds, Snapshot
from flexgs_edge.methods.paper.prune import ranks_from_order


class RankedPath(PruneRounds):
    """Rows go in the order of a score; how many go, and all else, is as measured.

    The measured costs are handed out again by rank: the row of the lowest score gets the lowest of them. So a multiplier
    removes about as many rows as it would by the costs themselves.

    Parameters
    ----------
    order : np.ndarray
        [N] i64, rows of the scene, least important first.
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
        # Rows that no pose sees have no cost to give away, and stay.
        seen = np.flatnonzero(costs.weight2 > 0)
        removal = costs.removal.copy()
        removal[seen[np.argsort(self._ranks[self.rows[snapshot.rows[seen]]])]] = np.sort(removal[seen])
        snapshot.costs = replace(costs, removal=removal)


class OnePassPath(PruneRounds):
    """Costs as the first pass over the whole scene measured them; colours are mended on the way all the same."""

    def descend(self, share: float) -> Snapshot:
        """See `PruneRounds.descend`."""
        last = self.snapshots[-1]
        snapshot = super().descend(share)
        kept = np.searchsorted(last.rows, snapshot.rows)
        # Weights and mean colours belong to the colours as they are now.
        snapshot.costs = replace(snapshot.costs, removal=last.costs.removal[kept], sh=last.costs.sh[:, kept])
        return snapshot


class SomeDegrees(GridSearch):
    """Gaussians that stay keep SH up to one of a few degrees; a subclass says which."""

    with_none: ClassVar[bool]

    def choose(self, costs: RemovalCosts, multiplier: float) -> tuple[np.ndarray, np.ndarray]:
        """See `MultiplierSearch.choose`."""
        top = len(costs.sh)
        return choose_among(costs, self.bits, multiplier, (0, top) if self.with_none else (top,))


class AllOrNone(SomeDegrees):
    """All SH or none, for each Gaussian."""

    with_none = True


class FullSh(SomeDegrees):
    """All SH for every Gaussian that some pose sees."""

    with_none = False


def choose_among(
    costs: RemovalCosts, bits: BitModel, multiplier: float, degrees: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    """As `flexgs_edge.methods.best.allocation.choose`, with these SH degrees to choose from."""
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
    """The method, or the method with one part taken away.

    Parameters
    ----------
    name : str
        In tables.
    words : str
        What stands in the part's place.
    search : type
        Of `GridSearch`.
    path : callable
        Builds the path from the arguments of `PruneRounds`.
    refit : bool
        As for `compress`.
    """

    name: str
    words: str
    search: type[GridSearch] = GridSearch
    path: Callable[..., PruneRounds] = PruneRounds
    refit: bool = True


WHOLE = Variant("whole", "nothing is taken away")


def parts_of(order: np.ndarray, sh_degree: int) -> tuple[Variant, ...]:
    """Every part, taken away alone; those of the SH only where there are some.

    Parameters
    ----------
    order : np.ndarray
        [N] i64, rows by the paper's score, least important first.
    """
    parts = [
        Variant(
            "gs ranks",
            "Gaussians go in the order of the paper's score gs, ranked once, in place of measured costs",
            path=partial(RankedPath, order=order),
        ),
        Variant(
            "one pass", "costs of one pass over the whole scene, never measured again as others go", path=OnePassPath
        ),
        Variant("no refit", "colours stay as they are (--no-refit)", refit=False),
    ]
    if sh_degree:
        parts += [
            Variant("SH all or none", "each Gaussian keeps all SH or none", search=AllOrNone),
            Variant("full SH", "every Gaussian keeps all SH", search=FullSh),
        ]
    return tuple(parts)
