"""Rounds of pruning whose costs are known, and a maker of grids from them."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.memory.storage import IN_MEMORY
from flexgs_edge.methods.best.choose_steps import GEOMETRY, Slopes, choose_steps
from flexgs_edge.methods.best.costs import RemovalCosts, Snapshot
from flexgs_edge.methods.best.effort import Effort
from flexgs_edge.methods.best.grid_maker import GridMaker
from flexgs_edge.methods.best.rounds import take_rows
from flexgs_edge.scene.fields import FIELD
from synthetic import random_scene

SLOPES = Slopes(dict.fromkeys(GEOMETRY, 100.0))
UNIT = choose_steps(SLOPES, np.ones(1), np.zeros(1), 0, 1.0).opacity
EFFORT = Effort(keep=0.8, refit_rounds=1, subsets=2, close=0.03, near=0.02, few=8, views=8, pixels=24, refitted=0.61)
AT = 1e-4
"""The multiplier whose bits are worth as much as the cheaper Gaussians."""


class FakeRounds:
    """A path whose costs are known: descending removes the cheapest and changes no cost."""

    storage = IN_MEMORY

    def __init__(self, count: int = 600, degree: int = 1, unseen: int = 0, scale: float = 1.0) -> None:
        rng = np.random.default_rng(81)
        planes = random_scene(count, 82, degree).read(slice(0, count), list(FIELD))
        weight2 = np.where(np.arange(count) < unseen, 0.0, 1.0)
        removal = rng.lognormal(math.log(scale * AT * 50), 3, count) * (weight2 > 0)
        sh = rng.lognormal(math.log(scale * AT * 10), 2, (degree, count)) * (weight2 > 0)
        costs = RemovalCosts(removal, weight2, sh, np.zeros((degree, 3, count), np.float32))
        self.original = SimpleNamespace(origin=np.zeros(3), cameras=range(10), renderer=None, turns=None)
        self.snapshots = [Snapshot(np.arange(count), planes, costs)]
        self.renewed: set[int] = set()
        self.shares: list[float] = []

    def descend(self, share: float) -> Snapshot:
        self.shares.append(share)
        last = self.snapshots[-1]
        keep = np.flatnonzero(last.cheapest(last.count - round(last.count * share)))
        c = last.costs
        costs = RemovalCosts(c.removal[keep], c.weight2[keep], c.sh[:, keep], c.sh_mean[:, :, keep])
        self.snapshots.append(Snapshot(last.rows[keep], take_rows(last.planes, keep), costs))
        return self.snapshots[-1]

    def let_go(self) -> None:
        """All lies in memory."""

    def renew(self, change: Callable[[], tuple[np.ndarray, dict[str, np.ndarray]]]) -> None:
        rows, planes = change()
        self.renewed.add(len(self.snapshots))
        c, keep = self.snapshots[0].costs, rows
        costs = RemovalCosts(c.removal[keep], c.weight2[keep], c.sh[:, keep], c.sh_mean[:, :, keep])
        self.snapshots.append(Snapshot(rows, planes, costs))

    def undo(self) -> None:
        self.snapshots.pop()


class KnownMaker(GridMaker):
    """Slopes and costs are known, and nothing is drawn."""

    def _probe_slopes(self, snapshot: Snapshot) -> Slopes:
        return SLOPES

    def _removal_costs(self, grid: GridScene) -> np.ndarray:
        return np.arange(grid.count, dtype=np.float64)

    def _refit_colours(self, planes: Any, *_: Any, **__: Any) -> Any:
        return planes
