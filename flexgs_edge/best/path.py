"""One descending path of prune and rescore: removed Gaussians interact, so costs are measured again after each part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexgs_edge.cameras import Camera
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.refit import refit_colours
from flexgs_edge.render import Renderer
from flexgs_edge.render.targets import TargetViews
from flexgs_edge.scene.source import MemorySource
from flexgs_edge.score.removal import RemovalCosts, measure_costs


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
        The original from these poses.
    """

    def __init__(
        self,
        renderer: Renderer,
        planes: dict[str, np.ndarray],
        rows: np.ndarray,
        origin: np.ndarray,
        cameras: Sequence[Camera],
        targets: TargetViews,
        progress: Progress = SILENT,
    ) -> None:
        self.renderer, self.origin = renderer, origin
        self.cameras, self.targets, self.progress = cameras, targets, progress
        start = take_rows(planes, rows)
        self.snapshots = [Snapshot(rows, start, self._measure(start))]

    def descend(self, share: float) -> Snapshot:
        """Keep `share` of the last snapshot, refit its colours in one round, and measure costs again."""
        last = self.snapshots[-1]
        keep = np.flatnonzero(last.cheapest(last.count - round(last.count * share)))
        planes = take_rows(last.planes, keep)
        degrees = np.full(len(keep), 4, np.uint8)
        planes = refit_colours(
            self.renderer, planes, degrees, self.origin, self.cameras, self.targets, rounds=1, progress=self.progress
        )
        self.snapshots.append(Snapshot(last.rows[keep], planes, self._measure(planes)))
        return self.snapshots[-1]

    def _measure(self, planes: dict[str, np.ndarray]) -> RemovalCosts:
        with self.renderer.load(MemorySource(planes, origin=self.origin)) as scene:
            return measure_costs(self.renderer, scene, self.cameras, progress=self.progress)


def take_rows(planes: dict[str, np.ndarray], rows: np.ndarray) -> dict[str, np.ndarray]:
    """The planes' columns `rows`, C-contiguous."""
    return {name: np.ascontiguousarray(values[:, rows]) for name, values in planes.items()}
