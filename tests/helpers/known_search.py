"""Searches on worlds whose size and loss are known functions of the multiplier."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from flexgs_edge.goals.target import Measurement, Target
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.memory.storage import IN_MEMORY, Storage
from flexgs_edge.methods.best.candidates import Candidate, RateResult
from flexgs_edge.methods.best.choose_steps import GEOMETRY, Slopes, choose_steps
from flexgs_edge.methods.best.costs import RemovalCosts
from flexgs_edge.methods.best.effort import Effort
from flexgs_edge.methods.best.grid_search import GridSearch
from flexgs_edge.methods.best.rounds import take_rows
from flexgs_edge.methods.best.snapshot import Snapshot
from flexgs_edge.scene.fields import FIELD
from synthetic import random_scene

SLOPES = Slopes(dict.fromkeys(GEOMETRY, 100.0))
UNIT = choose_steps(SLOPES, np.ones(1), np.zeros(1), 0, 1.0).opacity
EFFORT = Effort(keep=0.8, refit_rounds=1, subsets=2, steps=4, close=0.03, few=8, views=8, pixels=24)
AT = 1e-4
BYTES = 4000
"""The multiplier at which the worlds lose 1 dB, and the bytes that they take there (53 bits for each of 600 Gaussians)."""


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
        self.original = SimpleNamespace(
            origin=np.zeros(3), cameras=range(10), bench=SimpleNamespace(renderer=None), turns=None
        )
        self.snapshots = [Snapshot(np.arange(count), planes, costs)]
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
        c, keep = self.snapshots[0].costs, rows
        costs = RemovalCosts(c.removal[keep], c.weight2[keep], c.sh[:, keep], c.sh_mean[:, :, keep])
        self.snapshots.append(Snapshot(rows, planes, costs))


class World:
    """Size and loss as functions of the multiplier, which is read back from the steps of the grid made last."""

    multiplier: float | None = None

    def __init__(self, loss: Callable[[float], float], size: Callable[[float], float], floor: float = 0.0) -> None:
        self.loss, self.size, self.floor = loss, size, floor
        self.grids: list[GridScene] = []
        self.rounds = FakeRounds()

    def size_of(self, grid: GridScene) -> int:
        self.grids.append(grid)
        assert self.multiplier is not None
        return round(self.size(self.multiplier))

    def measure(self, planes: dict[str, np.ndarray], estimate: bool = False) -> Measurement:
        if self.multiplier is None:  # the walk down, before anything was coded: pruning alone
            costs = self.rounds.snapshots[-1].costs
            least = costs.removal[costs.weight2 > 0].min(initial=1e9)
            drop = 0.45 * max(self.loss(max(least / 50, 1e-30)), self.floor)
        else:
            drop = max(self.loss(self.multiplier), self.floor)
        return Measurement(drop, 42 - 10 * math.log10(max(drop, 1e-9)), drop)


def powers(loss: float = 0.6, size: float = -0.45) -> World:
    return World(lambda m: (m / AT) ** loss, lambda m: BYTES * (m / AT) ** size)


class KnownSearch(GridSearch):
    """A search in a world: slopes are known, and the world learns the multiplier."""

    world: World

    def _to_grid(self, planes: Any, degrees: Any, steps: StepSizes, storage: Storage = IN_MEMORY) -> Any:
        self.world.multiplier = (steps.opacity / UNIT) ** 2
        return super()._to_grid(planes, degrees, steps, storage)

    def _probe_slopes(self, snapshot: Snapshot) -> Slopes:
        return SLOPES

    def _removal_costs(self, grid: GridScene) -> np.ndarray:
        return np.arange(grid.count, dtype=np.float64)


def search(
    world: World,
    target: Target,
    rounds: FakeRounds | None = None,
    best_effort: bool = False,
    kind: type[KnownSearch] = KnownSearch,
    **words: Any,
) -> RateResult[GridScene]:
    words = {"effort": EFFORT, "refit": False, **words}
    world.multiplier = None
    world.rounds = rounds or FakeRounds()
    found = kind(world.rounds, world.size_of, world.measure, **words)  # type: ignore[arg-type]
    found.world = world
    return found.run(target, best_effort)


def best_of(steps: tuple[Candidate, ...]) -> Candidate:
    """The smallest step that holds."""
    return min((step for step in steps if step.holds), key=lambda step: step.size)
