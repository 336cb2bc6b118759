"""Pruning in rounds: remove the cheapest Gaussians, measure the costs of the rest again, repeat.

Removed Gaussians interact, so costs that were measured once would mislead. Each round also moves colours a step towards
the original's renders. Searches start from the snapshots that the rounds leave behind.
"""

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from weakref import WeakMethod

import numpy as np

from flexgs_edge.cameras.camera import Camera, largest_of
from flexgs_edge.errors import InputError
from flexgs_edge.memory.storage import IN_MEMORY, Storage
from flexgs_edge.methods.best.checkpoint import Checkpoint
from flexgs_edge.methods.best.costs import (
    CostParts,
    RemovalCosts,
    Snapshot,
    cost_bytes,
    cost_parts,
    cost_sums,
    measure_parts,
    put_costs,
)
from flexgs_edge.methods.best.effort import LEAST_VIEWS
from flexgs_edge.methods.best.poses import KnownErrors
from flexgs_edge.methods.best.refit.colour import normal_bytes, normal_sums, step_colours
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.fit import sum_bytes
from flexgs_edge.scene.check import alive, invisible
from flexgs_edge.scene.curve import near_rows
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource, SceneSource, read_all
from flexgs_edge.views.references import Original
from flexgs_edge.views.sums import ViewSums

PARTS = 2
"""Each pruning round measures one of this many interleaved sets of cameras and reuses the sums of the others. One set
is slower, four make files larger: docs/results/tuning.md#parts"""
MOST_PARTS = 4
SNAPSHOTS_HELD = 2  # So many of the last snapshots never let their planes go: docs/results/tuning.md#let_go


def parts_of(views: int) -> int:
    """How many interleaved sets so many scored poses make.

    More than `PARTS` only if each has 48: docs/results/tuning.md#part_views
    """
    return max(min(PARTS, views // LEAST_VIEWS), min(MOST_PARTS, views // 48), 1)


class PruneRounds:
    """Prunes the whole scene round by round; `snapshots` keeps the result of each round, the smallest set last.

    Where arrays lie in files, snapshots that a search hardly needs again let their planes go.

    `original`: scored poses and those between them. If colours are refitted, the original's renders are put into its
    references, which are empty at first. `source`: the whole scene. Neighbours in space become neighbours in memory, so that
    views are drawn faster. `unseen_share`: share of the Gaussians that no pose sees to keep, 0 to 1 (default: all). Those that
    are largest and most opaque stay first. `checkpoint`: keeps every round. Rounds that it holds already are read instead of
    computed. `rows`: [n] i64, rows of the scene that the rounds begin with, without dead splats, in the order of the planes.
    `snapshots`: the results. `unseen`: how many rows no scored pose sees. Raises `InputError` if nothing is left of the scene.
    """

    def __init__(
        self,
        original: Original,
        source: SceneSource,
        refit: bool = True,  # refit colours in each round (default)
        unseen_share: float = 1.0,
        checkpoint: Checkpoint | None = None,
    ) -> None:
        self.original, self.refit, self.checkpoint, self._source = original, refit, checkpoint, source
        self.storage = original.renderer.storage
        self.rows, start = self._read()
        cameras = original.cameras
        count = parts_of(len(cameras))
        self._views = [range(first, len(cameras), count) for first in range(count)]
        self._parts: list[CostParts] = []
        self.snapshots: list[Snapshot] = []
        self.renewed: set[int] = set()  # Snapshots that a descent has made
        if not self._resumed():
            self._begin(start, unseen_share)
        first = self.snapshots[0]
        # Rows that the first snapshot lacks were seen by no pose.
        self.unseen = len(self.rows) - int(np.count_nonzero(first.costs.weight2 > 0))

    def _read(self) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Read the scene: rows that are alive, in near order, and their planes."""
        planes, storage = read_all(self._source, self.storage), self.storage
        rows = np.flatnonzero(alive(planes["opacity_logits"][0]))
        if not len(rows):
            raise invisible(self._source)
        rows = storage.take(rows, near_rows(storage.take(planes["means"], rows), storage))
        return rows, take_rows(planes, rows, storage)

    def _begin(self, start: dict[str, np.ndarray], unseen_share: float) -> None:
        """Measure costs on the whole scene, and draw the references."""
        original, renderer, storage = self.original, self.original.renderer, self.storage
        source = MemorySource(start, origin=original.origin)
        sum_bytes_a_row = sum_bytes(2) + cost_bytes(source.sh_degree)
        with renderer.load(source, sum_bytes_a_row, view_sums=2) as scene:
            self._parts = [self._measure(scene, some, keep=True) for some in self._views]
            in_turn = renderer.in_turn(scene, original.between)
            for view, camera in enumerate(in_turn, start=len(original.cameras)):
                original.references.add(view, renderer.render_planes(scene, camera))
        costs = RemovalCosts.of(self._parts, storage)
        rows = storage.copy(np.arange(len(self.rows)))
        keep = np.flatnonzero(~_hidden(start, costs.weight2, unseen_share))
        if not len(keep):
            raise InputError(
                f"none of {len(original.cameras)} scored views sees any Gaussian, and --unseen {unseen_share:g} keeps none of "
                "those that no view sees: nothing would be left. Give cameras that look at the scene, or leave --unseen out"
            )
        if len(keep) < len(rows):
            rows, start = storage.take(rows, keep), take_rows(start, keep, storage)
            self._parts = [part.take(keep, storage) for part in self._parts]
            costs = RemovalCosts.of(self._parts, storage)
        self._add(Snapshot(rows, start, costs), keep_views=True)

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
        turn = self._turn(len(self.snapshots))
        others = {part: sums.take(keep, self.storage) for part, sums in enumerate(self._parts) if part != turn}
        # What takes most room is not held while we measure. The whole scene can be read again.
        self._parts = []
        self.let_go(SNAPSHOTS_HELD - 1 if len(self.snapshots) > 1 else 0)
        measured = self._round(planes, turn)
        self._parts = [others.get(part, measured) for part in range(len(self._views))]
        costs = RemovalCosts.of(self._parts, self.storage)
        return self._add(Snapshot(self.storage.take(last.rows, keep), planes, costs))

    def _turn(self, number: int) -> int:
        """The part of the poses that the round for a snapshot looks at."""
        return (number - 1) % len(self._views)

    def _round(self, planes: dict[str, np.ndarray], turn: int) -> CostParts:
        """Measure costs over a part of the poses, and refit the colours of `planes`, in place, by one step."""
        source = MemorySource(planes, origin=self.original.origin)
        with self.original.renderer.load(source, sum_row_bytes(source.sh_degree), references=self.refit) as scene:
            views = self._views[turn]
            return self._measure_and_refit(scene, planes, views) if self.refit else self._measure(scene, views)

    def _again(self, number: int) -> dict[str, np.ndarray]:
        """The planes of a snapshot that let them go, by the same rounds from the last one before it that holds its own."""
        held = max((before for before in range(number) if self.snapshots[before].held), default=0)
        first = self.snapshots[held]
        planes = first.planes if first.held else take_rows(self._read()[1], first.rows, self.storage)
        for later in range(held + 1, number + 1):
            rows = np.searchsorted(self.snapshots[later - 1].rows, self.snapshots[later].rows)
            planes = take_rows(planes, rows, self.storage)
            self._round(planes, self._turn(later))
        return planes

    def renew(self, change: Callable[[], tuple[np.ndarray, dict[str, np.ndarray]]]) -> Snapshot:
        """Append rows and planes that a descent has moved, with costs measured anew over all poses.

        `change`: makes the rows ([n] i64, places in `rows`, ascending) and their planes. It is not called if a
        checkpoint has them.
        """
        self.renewed.add(len(self.snapshots))
        if self._resumed():
            return self.snapshots[-1]
        rows, planes = change()
        renderer = self.original.renderer
        source = MemorySource(planes, origin=self.original.origin)
        with renderer.load(source, sum_bytes(2) + cost_bytes(source.sh_degree), view_sums=2) as scene:
            self._parts = [self._measure(scene, some) for some in self._views]
        return self._add(Snapshot(rows, planes, RemovalCosts.of(self._parts, self.storage)))

    def undo(self) -> None:
        """Drop the last snapshot, and go on from the one before it, with costs measured anew.

        A checkpoint keeps no further rounds: a resumed run comes here by those that it has.
        """
        self.checkpoint = None
        self.renewed.discard(len(self.snapshots) - 1)
        self.snapshots.pop()
        before = self.snapshots.pop()
        self.renew(lambda: (before.rows, before.planes))

    def see(self, cameras: Sequence[Camera], number: int, known: KnownErrors | None) -> bool:
        """Score further poses, too, from snapshot `number` on; later ones are dropped. False if there are sets enough.

        `cameras`: the poses. They become a set of their own. `number`: a snapshot that descents have made, or the first
        one. Its costs are measured anew. `known`: descents look at poses by it.
        """
        if len(self._views) >= MOST_PARTS:
            return False
        original, renderer, count = self.original, self.original.renderer, len(self.original.cameras)
        planes, rows = self.snapshots[number].planes, self.snapshots[number].rows
        scored = [*original.cameras, *cameras]
        original.references.make_room(count, len(cameras))
        turns = None if original.turns is None or known is None else known.slopes([*scored, *original.between])
        self.original = original = replace(original, cameras=scored, turns=turns)
        if self.storage.spills:
            renderer.largest = largest_of(scored)
        with renderer.load(self._source) as scene:
            for view, camera in enumerate(renderer.in_turn(scene, cameras), start=count):
                original.references.add(view, renderer.render_planes(scene, camera))
        self._views.append(range(count, len(scored)))
        del self.snapshots[number:]
        self.checkpoint = None  # it holds the rounds without these poses
        self.renew(lambda: (rows, planes))
        return True

    def _add(self, snapshot: Snapshot, keep_views: bool = False) -> Snapshot:
        """Append a snapshot, and save it if there is a checkpoint."""
        self._hold(snapshot)
        if self.checkpoint is not None:
            arrays = [("rows", snapshot.rows), *((f"plane-{name}", values) for name, values in snapshot.planes.items())]
            for number, part in enumerate(self._parts):
                arrays += [(f"part-{number}-{array.name}", getattr(part, array.name)) for array in fields(part)]
            if keep_views and self.refit:
                arrays += [(f"view-{view}", self.original.references[view]) for view in range(len(self.original.poses))]
            self.checkpoint.save(len(self.snapshots) - 1, arrays)
        return snapshot

    def _hold(self, snapshot: Snapshot) -> None:
        """Append a snapshot, and let earlier ones go."""
        self.snapshots.append(snapshot)
        self.let_go(SNAPSHOTS_HELD)

    def let_go(self, held: int = 0) -> None:
        """Free the planes of all snapshots but the last `held`, and those of descents, where arrays lie in files."""
        if self.storage.spills:
            for number in range(len(self.snapshots) - held):
                if number not in self.renewed:
                    self.snapshots[number].let_go(self._maker(number))

    def _maker(self, number: int) -> Callable[[], dict[str, np.ndarray]]:
        """Makes the planes of a snapshot. It holds on to nothing, or a search that has ended would keep its files."""
        again = WeakMethod(self._again)

        def make() -> dict[str, np.ndarray]:
            method = again()
            assert method is not None
            return method(number)

        return make

    def _resumed(self) -> bool:
        """Read the next snapshot from the checkpoint of an earlier run; False if it holds none."""
        number = len(self.snapshots)
        if self.checkpoint is None or not self.checkpoint.has(number):
            return False
        arrays = self.checkpoint.load(number, self.storage)
        planes = {name: arrays[f"plane-{name}"] for name in FIELD}
        self._parts = [
            CostParts(*(arrays[f"part-{part}-{array.name}"] for array in fields(CostParts)))
            for part in range(len(self._views))
        ]
        self._hold(Snapshot(arrays["rows"], planes, RemovalCosts.of(self._parts, self.storage)))
        if number == 0 and self.refit:
            for view in range(len(self.original.poses)):
                self.original.references.add(view, arrays[f"view-{view}"])
        return True

    def _measure(self, scene: DeviceScene, views: Sequence[int], keep: bool = False) -> CostParts:
        """Measure costs over some of the poses; `keep` their pictures, as references, if colours are refitted."""
        original = self.original

        def drawn(place: int, picture: np.ndarray) -> None:
            original.references.add(views[place], picture)

        cameras = [original.cameras[view] for view in views]
        kept = drawn if keep and self.refit else None
        return measure_parts(original.renderer, scene, cameras, scene.sh_degree, original.progress, kept)

    def _measure_and_refit(self, scene: DeviceScene, planes: dict[str, np.ndarray], views: Sequence[int]) -> CostParts:
        makers = [cost_sums(self.original.renderer, scene.sh_degree, first=4), normal_sums(self.original.renderer)]
        both = ViewSums(self.original.renderer, scene, makers)
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
                for some, values in normal.parts(rows.start):
                    step_colours(planes, degrees, some, values)
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
