"""One descending path of prune and rescore: removed Gaussians interact, so costs are measured again after each part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexgs_edge.best.effort import LEAST_VIEWS
from flexgs_edge.cameras import Camera
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.refit import NormalSums, normal_bytes, step_colours
from flexgs_edge.render import DeviceScene, Renderer, sum_bytes
from flexgs_edge.render.targets import TargetViews
from flexgs_edge.scene.source import MemorySource
from flexgs_edge.score.removal import CostParts, CostSums, RemovalCosts, moment_bytes

PARTS = 2
"""Interleaved parts of the poses; each round measures one, and keeps the sums of the others for the rows that stay. Bytes at 1 dB
on fox (balanced, refits alike) by processor seconds: one part, .8 kept a round 585 kB / 141 s; two parts, .8 571 / 110, .88 558 /
134; four parts, .88 581 / 122."""


@dataclass
class Snapshot:
    """A set of kept Gaussians on the path, with colours refitted to it and costs measured on it.

    Attributes
    ----------
    rows : np.ndarray
        [n] i64, rows of the scene, ascending.
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
        keep = np.ones(self.count, bool)
        seen = np.flatnonzero(self.costs.weight2 > 0)
        keep[seen[np.argsort(self.costs.removal[seen], kind="stable")[:count]]] = False
        return keep


class PrunePath:
    """Walks down from the whole scene; `snapshots[-1]` is the smallest set so far.

    Parameters
    ----------
    renderer : Renderer
    planes : dict
        Stored planes of the whole scene ([width, N] f32 by field).
    rows : np.ndarray
        [n] i64, rows to start from (dead splats left out).
    origin : np.ndarray
        [3] f64.
    cameras : sequence of Camera
        Scored poses.
    targets : TargetViews
        Empty; the original from these poses is put into it if colours are to be mended.
    refit : bool
        Mend colours on the way.
    unseen : float
        Share of the Gaussians that no pose sees that stays, the most visible ones from elsewhere first.
    between : sequence of Camera
        Further poses that the original is drawn from (targets from `len(cameras)` on): a descent that knew the scored ones alone
        would fit them at the cost of what lies between.
    """

    def __init__(
        self,
        renderer: Renderer,
        planes: dict[str, np.ndarray],
        rows: np.ndarray,
        origin: np.ndarray,
        cameras: Sequence[Camera],
        targets: TargetViews,
        refit: bool = True,
        unseen: float = 1.0,
        progress: Progress = SILENT,
        between: Sequence[Camera] = (),
    ) -> None:
        self.renderer, self.origin, self.refit = renderer, origin, refit
        self.cameras, self.targets, self.progress = cameras, targets, progress
        self.between = between
        start = take_rows(planes, rows)
        source = MemorySource(start, origin=origin)
        count = max(min(PARTS, len(cameras) // LEAST_VIEWS), 1)
        self._views = [range(first, len(cameras), count) for first in range(count)]
        with renderer.load(source, sum_bytes(2) + moment_bytes(source.sh_degree)) as scene:
            self._parts = [self._measure(scene, some, keep=True) for some in self._views]
            for view, camera in enumerate(between, start=len(cameras)):
                targets.add(view, renderer.render_planes(scene, camera))
        costs = RemovalCosts.of(self._parts)
        keep = np.flatnonzero(~_hidden(start, costs.weight2, unseen))
        if len(keep) < len(rows):
            rows, start = rows[keep], take_rows(start, keep)
            self._parts = [part.take(keep) for part in self._parts]
            costs = RemovalCosts.of(self._parts)
        self.snapshots = [Snapshot(rows, start, costs)]

    def descend(self, share: float) -> Snapshot:
        """Keep `share` of the last snapshot, measure costs again in the next part of the poses, and mend colours by one step.

        One pass gives both, so the costs are those before the step: it moves colours by little, the rest of the change is in the
        rows that went.
        """
        last = self.snapshots[-1]
        keep = np.flatnonzero(last.cheapest(last.count - round(last.count * share)))
        planes = take_rows(last.planes, keep)
        source = MemorySource(planes, origin=self.origin)
        with self.renderer.load(source, sums_room(source.sh_degree), targets=self.refit) as scene:
            turn = (len(self.snapshots) - 1) % len(self._parts)
            views = self._views[turn]
            measured = self._measure_and_mend(scene, planes, views) if self.refit else self._measure(scene, views)
        self._parts = [measured if part == turn else sums.take(keep) for part, sums in enumerate(self._parts)]
        self.snapshots.append(Snapshot(last.rows[keep], planes, RemovalCosts.of(self._parts)))
        return self.snapshots[-1]

    def _measure(self, scene: DeviceScene, views: Sequence[int], keep: bool = False) -> CostParts:
        costs = CostSums(self.renderer, scene)
        try:
            for view in self.progress.track(views, "measuring costs", len(views)):
                costs.add_view(self.renderer.removal_sums(scene, self.cameras[view]))
                if keep and self.refit:
                    self.targets.add(view, self.renderer.drawn_planes())
            return costs.finish()
        finally:
            costs.release()

    def _measure_and_mend(self, scene: DeviceScene, planes: dict[str, np.ndarray], views: Sequence[int]) -> CostParts:
        costs, normal = CostSums(self.renderer, scene), NormalSums(self.renderer, scene)
        try:
            for view in self.progress.track(views, "measuring costs", len(views)):
                sums = self.renderer.residual_and_removal_sums(scene, self.cameras[view], self.targets[view])
                costs.add_view(sums, first=4)
                normal.add_view(sums)
            # Nothing has lost its SH on the path yet.
            step_colours(planes, np.full(scene.count, 4, np.uint8), normal.finish())
            return costs.finish()
        finally:
            costs.release()
            normal.release()


def sums_room(sh_degree: int) -> int:
    """Bytes a row that measuring costs and mending colours in one pass takes on the backend."""
    return sum_bytes(6) + moment_bytes(sh_degree) + normal_bytes(sh_degree)


def _hidden(planes: dict[str, np.ndarray], weight2: np.ndarray, share: float) -> np.ndarray:
    """[n] bool: all but `share` of the rows that no pose sees, by opacity times the area of the two longest axes."""
    unseen = np.flatnonzero(weight2 <= 0)
    logits, scales = planes["opacity_logits"][0, unseen].astype(np.float64), planes["log_scales"][:, unseen]
    visible = -np.logaddexp(0.0, -logits) + np.sort(scales, axis=0)[1:].sum(axis=0, dtype=np.float64)
    gone = np.zeros(len(weight2), bool)
    gone[unseen[np.argsort(visible, kind="stable")[: len(unseen) - round(share * len(unseen))]]] = True
    return gone


def take_rows(planes: dict[str, np.ndarray], rows: np.ndarray) -> dict[str, np.ndarray]:
    """The planes' columns `rows`, C-contiguous."""
    return {name: np.ascontiguousarray(values[:, rows]) for name, values in planes.items()}
