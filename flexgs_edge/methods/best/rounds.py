"""One descending path of prune and rescore: removed Gaussians interact, so costs are measured again after each part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.memory.storage import IN_MEMORY, Storage
from flexgs_edge.methods.best.checkpoint import Checkpoint
from flexgs_edge.methods.best.costs import (
    PART_NAMES,
    CostParts,
    RemovalCosts,
    cost_parts,
    cost_sums,
    moment_bytes,
    put_costs,
)
from flexgs_edge.methods.best.effort import LEAST_VIEWS
from flexgs_edge.methods.best.refit.colour import normal_bytes, normal_sums, step_colours
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.fit import sum_bytes
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource
from flexgs_edge.views.bench import Bench
from flexgs_edge.views.references import References
from flexgs_edge.views.sums import ViewSums

PARTS = 2
"""Each pruning round measures one of this many interleaved sets of cameras and reuses the sums of the others. One set
is slower, four make files larger: docs/results/tuning.md#parts"""


@dataclass
class Snapshot:
    """A set of kept Gaussians on the path, with colours refitted to it and costs measured on it.

    Attributes
    ----------
    rows : np.ndarray
        [n] i64, places in the rows that the path began with (`PruneRounds.rows`), ascending.
    planes : dict
        Stored planes of these rows.
    costs : RemovalCosts
        Of these rows.
    """

    rows: np.ndarray
    planes: dict[str, np.ndarray]
    costs: RemovalCosts

    @property
    def count(self) -> int:
        """Gaussians kept."""
        return len(self.rows)

    def cheapest(self, count: int) -> np.ndarray:
        """[n] bool: all but the `count` cheapest to remove of those that some pose sees (ties by row)."""
        seen = self.costs.weight2 > 0
        return ~lowest(np.where(seen, self.costs.removal, np.inf), min(count, int(np.count_nonzero(seen))))


def lowest(values: np.ndarray, count: int) -> np.ndarray:
    """[n] bool: the `count` smallest of `values` (all, where there are no more), of equal ones the first."""
    if count >= len(values):
        return np.ones(len(values), bool)
    if count <= 0:
        return np.zeros(len(values), bool)
    edge = np.partition(values, count - 1)[count - 1]
    chosen: np.ndarray = values < edge
    chosen[np.flatnonzero(values == edge)[: count - int(np.count_nonzero(chosen))]] = True
    return chosen


class PruneRounds:
    """Walks down from the whole scene; `snapshots[-1]` is the smallest set so far, and `unseen` rows were in no scored pose.

    Parameters
    ----------
    bench : Bench
    planes : dict
        Stored planes of the whole scene ([width, N] f32 by field).
    rows : np.ndarray
        [n] i64, rows of the scene to start from (dead splats left out), in the order that the path keeps.
    origin : np.ndarray
        [3] f64.
    cameras : sequence of Camera
        Scored poses.
    targets : References
        Empty; the original from these poses is put into it if colours are to be mended.
    refit : bool
        Mend colours on the way.
    unseen : float
        Share of the Gaussians that no pose sees that stays, the most visible ones from elsewhere first.
    checkpoint : Checkpoint, optional
        Keeps every round; rounds that are there are taken from it.
    between : sequence of Camera
        Further poses that the original is drawn from (targets from `len(cameras)` on): a descent that knew the scored ones alone
        would fit them at the cost of what lies between.
    """

    def __init__(
        self,
        bench: Bench,
        planes: dict[str, np.ndarray],
        rows: np.ndarray,
        origin: np.ndarray,
        cameras: Sequence[Camera],
        targets: References,
        refit: bool = True,
        unseen: float = 1.0,
        progress: Progress = SILENT,
        checkpoint: Checkpoint | None = None,
        between: Sequence[Camera] = (),
    ) -> None:
        self.checkpoint = checkpoint
        self.bench, self.renderer, self.origin, self.refit = bench, bench.renderer, origin, refit
        self.cameras, self.targets, self.progress = cameras, targets, progress
        self.storage, self.rows, self.between = bench.renderer.storage, rows, between
        count = max(min(PARTS, len(cameras) // LEAST_VIEWS), 1)
        self._views = [range(first, len(cameras), count) for first in range(count)]
        self._parts: list[CostParts] = []
        self.snapshots: list[Snapshot] = []
        if not self._resumed():
            self._begin(planes, unseen)
        first = self.snapshots[0]
        # What is gone from the first snapshot was seen by no pose.
        self.unseen = len(rows) - int(np.count_nonzero(first.costs.weight2 > 0))

    def _begin(self, planes: dict[str, np.ndarray], unseen: float) -> None:
        """Measure costs on the whole scene."""
        storage, start = self.storage, take_rows(planes, self.rows, self.storage)
        source = MemorySource(start, origin=self.origin)
        sum_bytes_a_row = sum_bytes(2) + moment_bytes(source.sh_degree)
        with self.renderer.load(source, sum_bytes_a_row, view_sums=2) as scene:
            self._parts = [self._measure(scene, some, keep=True) for some in self._views]
            for view, camera in enumerate(self.renderer.in_turn(scene, self.between), start=len(self.cameras)):
                self.targets.add(view, self.renderer.render_planes(scene, camera))
        costs = RemovalCosts.of(self._parts, storage)
        rows = storage.copy(np.arange(len(self.rows)))
        keep = np.flatnonzero(~_hidden(start, costs.weight2, unseen))
        if len(keep) < len(rows):
            rows, start = storage.take(rows, keep), take_rows(start, keep, storage)
            self._parts = [part.take(keep, storage) for part in self._parts]
            costs = RemovalCosts.of(self._parts, storage)
        self._add(Snapshot(rows, start, costs), keep_views=True)

    def scene_rows(self, places: np.ndarray) -> np.ndarray:
        """[n] i64, rows of the scene, ascending, of places on the path (`Snapshot.rows`)."""
        return np.sort(self.rows[places])

    def descend(self, share: float) -> Snapshot:
        """Keep `share` of the last snapshot, measure costs again in the next part of the poses, and mend colours by one step.

        One pass gives both, so the costs are those before the step: it moves colours by little, the rest of the change is in the
        rows that went.
        """
        if self._resumed():
            return self.snapshots[-1]
        last = self.snapshots[-1]
        keep = np.flatnonzero(last.cheapest(last.count - round(last.count * share)))
        planes = take_rows(last.planes, keep, self.storage)
        source = MemorySource(planes, origin=self.origin)
        with self.renderer.load(source, sum_row_bytes(source.sh_degree), targets=self.refit) as scene:
            turn = (len(self.snapshots) - 1) % len(self._parts)
            views = self._views[turn]
            measured = self._measure_and_mend(scene, planes, views) if self.refit else self._measure(scene, views)
        self._parts = [
            measured if part == turn else sums.take(keep, self.storage) for part, sums in enumerate(self._parts)
        ]
        costs = RemovalCosts.of(self._parts, self.storage)
        return self._add(Snapshot(self.storage.take(last.rows, keep), planes, costs))

    def _add(self, snapshot: Snapshot, keep_views: bool = False) -> Snapshot:
        """Append a snapshot, and keep it for a later run where that is asked for."""
        self.snapshots.append(snapshot)
        if self.checkpoint is not None:
            arrays = [("rows", snapshot.rows), *((f"plane-{name}", values) for name, values in snapshot.planes.items())]
            for number, part in enumerate(self._parts):
                arrays += [(f"part-{number}-{name}", getattr(part, name)) for name in PART_NAMES]
            if keep_views and self.refit:
                arrays += [
                    (f"view-{view}", self.targets[view]) for view in range(len(self.cameras) + len(self.between))
                ]
            self.checkpoint.save(len(self.snapshots) - 1, arrays)
        return snapshot

    def _resumed(self) -> bool:
        """Take the next snapshot from where an earlier run kept it; False where it did not."""
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
            for view in range(len(self.cameras) + len(self.between)):
                self.targets.add(view, arrays[f"view-{view}"])
        return True

    def _measure(self, scene: DeviceScene, views: Sequence[int], keep: bool = False) -> CostParts:
        costs = ViewSums(self.bench, scene, [cost_sums(self.renderer, scene.sh_degree)])
        try:
            keep = keep and self.refit
            drawn = costs.draw("removal_sums", [self.cameras[view] for view in views], pictures=keep)
            for view, picture in zip(self.progress.track(views, "measuring costs", len(views)), drawn, strict=True):
                if keep:
                    self.targets.add(view, picture())
            found = cost_parts(scene.sh_degree, scene.count, self.storage)
            for rows, (sums,) in costs.parts():
                put_costs(found, rows, sums)
            return found
        finally:
            costs.release()

    def _measure_and_mend(self, scene: DeviceScene, planes: dict[str, np.ndarray], views: Sequence[int]) -> CostParts:
        makers = [cost_sums(self.renderer, scene.sh_degree, first=4), normal_sums(self.renderer)]
        both = ViewSums(self.bench, scene, makers)
        # Nothing has lost its SH on the path yet.
        degrees = np.full(scene.count, 4, np.uint8)
        try:
            cameras = [self.cameras[view] for view in views]
            drawn = both.draw("residual_and_removal_sums", cameras, lambda place: self.targets[views[place]])
            for _ in self.progress.track(drawn, "measuring costs", len(views)):
                pass
            found = cost_parts(scene.sh_degree, scene.count, self.storage)
            for rows, (costs, normal) in both.parts():
                put_costs(found, rows, costs)
                step_colours(planes, degrees, rows, normal.values())
            return found
        finally:
            both.release()


def sum_row_bytes(sh_degree: int) -> int:
    """Bytes a row that measuring costs and mending colours in one pass takes on the backend."""
    return sum_bytes(6) + moment_bytes(sh_degree) + normal_bytes(sh_degree)


def _hidden(planes: dict[str, np.ndarray], weight2: np.ndarray, share: float) -> np.ndarray:
    """[n] bool: all but `share` of the rows that no pose sees, by opacity times the area of the two longest axes."""
    gone = np.zeros(len(weight2), bool)
    unseen = np.flatnonzero(weight2 <= 0)
    if round(share * len(unseen)) == len(unseen):
        return gone
    logits, scales = planes["opacity_logits"][0, unseen].astype(np.float64), planes["log_scales"][:, unseen]
    visible = -np.logaddexp(0.0, -logits) + np.sort(scales, axis=0)[1:].sum(axis=0, dtype=np.float64)
    gone[unseen[np.argsort(visible, kind="stable")[: len(unseen) - round(share * len(unseen))]]] = True
    return gone


def take_rows(planes: dict[str, np.ndarray], rows: np.ndarray, storage: Storage = IN_MEMORY) -> dict[str, np.ndarray]:
    """The planes' columns `rows`, C-contiguous."""
    return {name: storage.take(values, rows) for name, values in planes.items()}
