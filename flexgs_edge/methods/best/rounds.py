"""Pruning in rounds: remove the cheapest Gaussians, measure the costs of the rest again, repeat.

Removed Gaussians interact, so costs that were measured once would mislead. Each round also moves colours a step towards
the original's renders. Searches start from the snapshots that the rounds leave behind.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from flexgs_edge.errors import InputError
from flexgs_edge.memory.storage import IN_MEMORY, Storage
from flexgs_edge.methods.best.checkpoint import Checkpoint
from flexgs_edge.methods.best.costs import (
    PART_NAMES,
    CostParts,
    RemovalCosts,
    cost_bytes,
    cost_parts,
    cost_sums,
    put_costs,
)
from flexgs_edge.methods.best.effort import LEAST_VIEWS
from flexgs_edge.methods.best.refit.colour import normal_bytes, normal_sums, step_colours
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.fit import sum_bytes
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource
from flexgs_edge.views.original import Original
from flexgs_edge.views.sums import ViewSums

PARTS = 2
"""Each pruning round measures one of this many interleaved sets of cameras and reuses the sums of the others. One set
is slower, four make files larger: docs/results/tuning.md#parts"""
MOST_PARTS = 4
PART_VIEWS = 48
"""Many cameras make up to `MOST_PARTS` sets, if each has this many: docs/results/tuning.md#part_views"""


def parts_of(views: int) -> int:
    """How many interleaved sets so many scored poses make."""
    return max(min(PARTS, views // LEAST_VIEWS), min(MOST_PARTS, views // PART_VIEWS), 1)


@dataclass
class Snapshot:
    """The Gaussians that are kept after a round, with refitted colours and measured costs.

    Attributes
    ----------
    rows : np.ndarray
        [n] i64, places in the rows that the rounds began with (`PruneRounds.rows`), ascending.
    planes : dict
        Stored planes of these rows ([width, n] f32 by field).
    costs : RemovalCosts
        Costs of these rows.
    """

    rows: np.ndarray
    planes: dict[str, np.ndarray]
    costs: RemovalCosts

    @property
    def count(self) -> int:
        """Gaussians kept."""
        return len(self.rows)

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


class PruneRounds:
    """Prunes the whole scene round by round; `snapshots` keeps the result of each round, the smallest set last.

    The attribute `unseen` counts the rows that no scored pose sees.

    Parameters
    ----------
    original : Original
        Scored poses and those between them. If colours are refitted, the original's renders are put into its references,
        which are empty at first.
    planes : dict
        Stored planes of the whole scene ([width, N] f32 by field).
    rows : np.ndarray
        [n] i64, rows of the scene to start from, without dead splats. The rounds keep their order.
    refit : bool
        Refit colours in each round (default).
    unseen : float
        Share of the Gaussians that no pose sees to keep, 0 to 1 (default: all). Those that are largest and most opaque
        stay first.
    checkpoint : Checkpoint, optional
        Keeps every round. Rounds that it holds already are read instead of computed.
    """

    def __init__(
        self,
        original: Original,
        planes: dict[str, np.ndarray],
        rows: np.ndarray,
        refit: bool = True,
        unseen: float = 1.0,
        checkpoint: Checkpoint | None = None,
    ) -> None:
        self.original, self.rows, self.refit, self.checkpoint = original, rows, refit, checkpoint
        self.storage = original.bench.renderer.storage
        cameras = original.cameras
        count = parts_of(len(cameras))
        self._views = [range(first, len(cameras), count) for first in range(count)]
        self._parts: list[CostParts] = []
        self.snapshots: list[Snapshot] = []
        if not self._resumed():
            self._begin(planes, unseen)
        first = self.snapshots[0]
        # Rows that the first snapshot lacks were seen by no pose.
        self.unseen = len(rows) - int(np.count_nonzero(first.costs.weight2 > 0))

    def _begin(self, planes: dict[str, np.ndarray], unseen: float) -> None:
        """Measure costs on the whole scene, and draw the references."""
        original, renderer, storage = self.original, self.original.bench.renderer, self.storage
        start = take_rows(planes, self.rows, storage)
        source = MemorySource(start, origin=original.origin)
        sum_bytes_a_row = sum_bytes(2) + cost_bytes(source.sh_degree)
        with renderer.load(source, sum_bytes_a_row, view_sums=2) as scene:
            self._parts = [self._measure(scene, some, keep=True) for some in self._views]
            in_turn = renderer.in_turn(scene, original.between)
            for view, camera in enumerate(in_turn, start=len(original.cameras)):
                original.references.add(view, renderer.render_planes(scene, camera))
        costs = RemovalCosts.of(self._parts, storage)
        rows = storage.copy(np.arange(len(self.rows)))
        keep = np.flatnonzero(~_hidden(start, costs.weight2, unseen))
        if not len(keep):
            raise InputError(
                f"none of {len(original.cameras)} scored views sees any Gaussian, and --unseen {unseen:g} keeps none of those "
                "that no view sees: nothing would be left. Give cameras that look at the scene, or leave --unseen out"
            )
        if len(keep) < len(rows):
            rows, start = storage.take(rows, keep), take_rows(start, keep, storage)
            self._parts = [part.take(keep, storage) for part in self._parts]
            costs = RemovalCosts.of(self._parts, storage)
        self._add(Snapshot(rows, start, costs), keep_views=True)

    def scene_rows(self, places: np.ndarray) -> np.ndarray:
        """[n] i64, rows of the scene, ascending, from places in `rows` (`Snapshot.rows`)."""
        return np.sort(self.rows[places])

    def descend(self, share: float) -> Snapshot:
        """Do a round: keep `share` of the last snapshot, measure costs again, and refit colours by one step.

        The round looks at the next part of the poses. One pass gives both, so the costs are those before the step. This
        is close enough: most of the change comes from the rows that were removed.
        """
        if self._resumed():
            return self.snapshots[-1]
        last = self.snapshots[-1]
        keep = np.flatnonzero(last.cheapest(last.count - max(round(last.count * share), 1)))
        planes = take_rows(last.planes, keep, self.storage)
        source = MemorySource(planes, origin=self.original.origin)
        with self.original.bench.renderer.load(source, sum_row_bytes(source.sh_degree), references=self.refit) as scene:
            turn = (len(self.snapshots) - 1) % len(self._parts)
            views = self._views[turn]
            measured = self._measure_and_refit(scene, planes, views) if self.refit else self._measure(scene, views)
        self._parts = [
            measured if part == turn else sums.take(keep, self.storage) for part, sums in enumerate(self._parts)
        ]
        costs = RemovalCosts.of(self._parts, self.storage)
        return self._add(Snapshot(self.storage.take(last.rows, keep), planes, costs))

    def renew(self, change: Callable[[], tuple[np.ndarray, dict[str, np.ndarray]]]) -> Snapshot:
        """Append rows and planes that a descent has moved, with costs measured anew over all poses.

        Parameters
        ----------
        change : callable
            Makes the rows ([n] i64, places in `rows`, ascending) and their planes. It is not called if a checkpoint has them.
        """
        if self._resumed():
            return self.snapshots[-1]
        rows, planes = change()
        renderer = self.original.bench.renderer
        source = MemorySource(planes, origin=self.original.origin)
        with renderer.load(source, sum_bytes(2) + cost_bytes(source.sh_degree), view_sums=2) as scene:
            self._parts = [self._measure(scene, some) for some in self._views]
        return self._add(Snapshot(rows, planes, RemovalCosts.of(self._parts, self.storage)))

    def _add(self, snapshot: Snapshot, keep_views: bool = False) -> Snapshot:
        """Append a snapshot, and save it if there is a checkpoint."""
        self.snapshots.append(snapshot)
        if self.checkpoint is not None:
            arrays = [("rows", snapshot.rows), *((f"plane-{name}", values) for name, values in snapshot.planes.items())]
            for number, part in enumerate(self._parts):
                arrays += [(f"part-{number}-{name}", getattr(part, name)) for name in PART_NAMES]
            if keep_views and self.refit:
                arrays += [(f"view-{view}", self.original.references[view]) for view in range(len(self.original.poses))]
            self.checkpoint.save(len(self.snapshots) - 1, arrays)
        return snapshot

    def _resumed(self) -> bool:
        """Read the next snapshot from the checkpoint of an earlier run; False if it holds none."""
        number = len(self.snapshots)
        if self.checkpoint is None or not self.checkpoint.has(number):
            return False
        arrays = self.checkpoint.load(number, self.storage)
        planes = {name: arrays[f"plane-{name}"] for name in FIELD}
        self._parts = [
            CostParts(*(arrays[f"part-{part}-{name}"] for name in PART_NAMES)) for part in range(len(self._views))
        ]
        self.snapshots.append(Snapshot(arrays["rows"], planes, RemovalCosts.of(self._parts, self.storage)))
        if number == 0 and self.refit:
            for view in range(len(self.original.poses)):
                self.original.references.add(view, arrays[f"view-{view}"])
        return True

    def _measure(self, scene: DeviceScene, views: Sequence[int], keep: bool = False) -> CostParts:
        costs = ViewSums(self.original.bench, scene, [cost_sums(self.original.bench.renderer, scene.sh_degree)])
        try:
            keep = keep and self.refit
            drawn = costs.draw("removal_sums", [self.original.cameras[view] for view in views], pictures=keep)
            for view, picture in zip(
                self.original.progress.track(views, "measuring costs", len(views)), drawn, strict=True
            ):
                if keep:
                    self.original.references.add(view, picture())
            found = cost_parts(scene.sh_degree, scene.count, self.storage)
            for rows, (sums,) in costs.parts():
                put_costs(found, rows, sums)
            return found
        finally:
            costs.release()

    def _measure_and_refit(self, scene: DeviceScene, planes: dict[str, np.ndarray], views: Sequence[int]) -> CostParts:
        makers = [
            cost_sums(self.original.bench.renderer, scene.sh_degree, first=4),
            normal_sums(self.original.bench.renderer),
        ]
        both = ViewSums(self.original.bench, scene, makers)
        # The rounds drop no SH: only a multiplier does, later.
        degrees = np.full(scene.count, 4, np.uint8)
        try:
            cameras = [self.original.cameras[view] for view in views]
            drawn = both.draw(
                "residual_and_removal_sums", cameras, lambda place: self.original.references[views[place]]
            )
            for _ in self.original.progress.track(drawn, "measuring costs", len(views)):
                pass
            found = cost_parts(scene.sh_degree, scene.count, self.storage)
            for rows, (costs, normal) in both.parts():
                put_costs(found, rows, costs)
                step_colours(planes, degrees, rows, normal.values())
            return found
        finally:
            both.release()


def sum_row_bytes(sh_degree: int) -> int:
    """Bytes a row that one pass takes on the backend to measure costs and to refit colours."""
    return sum_bytes(6) + cost_bytes(sh_degree) + normal_bytes(sh_degree)


def _hidden(planes: dict[str, np.ndarray], weight2: np.ndarray, share: float) -> np.ndarray:
    """[n] bool: unseen rows to drop. `share` of them stays: those with the largest opacity times area of the two longest axes."""
    gone = np.zeros(len(weight2), bool)
    unseen = np.flatnonzero(weight2 <= 0)
    if round(share * len(unseen)) == len(unseen):
        return gone
    logits, scales = planes["opacity_logits"][0, unseen].astype(np.float64), planes["log_scales"][:, unseen]
    visible = -np.logaddexp(0.0, -logits) + np.sort(scales, axis=0)[1:].sum(axis=0, dtype=np.float64)
    gone[unseen[np.argsort(visible, kind="stable")[: len(unseen) - round(share * len(unseen))]]] = True
    return gone


def take_rows(planes: dict[str, np.ndarray], rows: np.ndarray, storage: Storage = IN_MEMORY) -> dict[str, np.ndarray]:
    """The columns `rows` of the planes, C-contiguous."""
    return {name: storage.take(values, rows) for name, values in planes.items()}
