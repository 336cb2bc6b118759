"""What a round of pruning leaves: the Gaussians that are kept, and what the removal of each would cost."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from flexgs_edge.methods.best.costs import RemovalCosts
from flexgs_edge.scene.source import Planes


class Snapshot:
    """The Gaussians that are kept after a round, with refitted colours and measured costs.

    `rows`: [n] i64, places in the rows that the rounds began with (`PruneRounds.rows`), ascending. `planes`: stored
    planes of these rows ([width, n] f32 by field). `costs`: costs of these rows.
    """

    def __init__(self, rows: np.ndarray, planes: Planes, costs: RemovalCosts) -> None:
        self.rows, self.costs = rows, costs
        self._planes: Planes | None = planes
        self._again: Callable[[], Planes] | None = None

    @property
    def count(self) -> int:
        """Gaussians kept."""
        return len(self.rows)

    @property
    def planes(self) -> Planes:
        """Stored planes of the rows. If they were let go, they are made again."""
        if self._planes is None:
            assert self._again is not None
            self._planes = self._again()
        return self._planes

    @property
    def held(self) -> bool:
        """Whether the planes need not be made again."""
        return self._planes is not None

    def let_go(self, again: Callable[[], Planes]) -> None:
        """Free the planes; `again` makes them once more if somebody asks for them."""
        self._planes, self._again = None, again

    def cheapest(self, count: int) -> np.ndarray:
        """[n] bool: False for the `count` rows that are cheapest to remove. Rows that no pose sees stay; ties go by row."""
        seen = self.costs.weight2 > 0
        return ~lowest(np.where(seen, self.costs.removal, np.inf), min(count, int(np.count_nonzero(seen))))


def lowest(values: np.ndarray, count: int) -> np.ndarray:
    """[n] bool: True for the `count` smallest of `values` (all, if there are no more). Of equal values the first ones count."""
    if count >= len(values):
        return np.ones(len(values), bool)
    if count <= 0:
        return np.zeros(len(values), bool)
    edge = np.partition(values, count - 1)[count - 1]
    chosen: np.ndarray = values < edge
    chosen[np.flatnonzero(values == edge)[: count - int(np.count_nonzero(chosen))]] = True
    return chosen
