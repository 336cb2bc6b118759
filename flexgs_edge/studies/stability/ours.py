"""Runs the method best for experiments: at a target."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.codec.v2.container import coded_size
from flexgs_edge.goals.target import Measurement, Target
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.grid.values import from_grid
from flexgs_edge.methods.best.grid_coder import GridCoder
from flexgs_edge.methods.best.grid_maker import GridMaker
from flexgs_edge.methods.best.method import grid_maker, open_rounds
from flexgs_edge.methods.best.poses import scored_poses
from flexgs_edge.methods.best.rounds import PruneRounds
from flexgs_edge.methods.best.search import search as search_by
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.run.judge import Judge, measurement_of
from flexgs_edge.scene.source import MemorySource, SceneSource
from flexgs_edge.studies.study_scene import StudyScene
from flexgs_edge.views.bench import Bench


@dataclass(frozen=True, eq=False)
class Whole:
    """A candidate of the method best."""

    grid: GridScene  # the integers of its file
    size: int  # bytes of its file, without settings in the header
    multiplier: float  # squared error that a bit is worth
    rows: np.ndarray  # [n] i64, rows of the scene that were kept, ascending
    reached: bool  # whether the target holds

    @property
    def source(self) -> MemorySource:
        """The decoded scene of its file."""
        return MemorySource(from_grid(self.grid), origin=self.grid.origin)


@contextmanager
def walked(
    studied: StudyScene,
    source: SceneSource,
    cameras: Sequence[Camera],
    bench: Bench | None = None,
    margin: bool = False,
) -> Iterator[PruneRounds]:
    """Open rounds of pruning over some poses (with `margin`, also generated ones), for any number of searches."""
    options, bench = replace(studied.run.options, views_margin=margin), bench or studied.bench
    run = replace(studied.run.of_source(source), options=options)
    poses = scored_poses(cameras, options, bench.renderer, source, studied.judge.covered_decides)
    with open_rounds(run, bench, poses.cameras, known=poses.known) as rounds:
        yield rounds


def search(studied: StudyScene, rounds: PruneRounds, target: Target, judge: Judge | None = None) -> Whole:
    """Search for a target; the closest candidate if none meets it."""
    judge = judge or studied.judge
    made = _search(studied, rounds, judge, rounds.original.bench.renderer)
    with studied.run.clock.stage("search"):
        found = search_by(made, target, best_effort=True)
    multiplier = found.chosen.multiplier
    return _whole(made, found.product, multiplier, found.reached)


def _search(studied: StudyScene, rounds: PruneRounds, judge: Judge, renderer: Renderer) -> GridMaker:
    def measure(planes: dict[str, np.ndarray], estimate: bool = False) -> Measurement:
        with renderer.load(MemorySource(planes, origin=rounds.original.origin)) as scene:
            return measurement_of(judge.estimate(scene) if estimate else judge.compare(scene))

    options = replace(studied.run.options, refit=True)
    made = grid_maker(options, GridCoder(renderer))(rounds, measure, None)
    assert isinstance(made, GridMaker)
    return made


def _whole(made: GridMaker, grid: GridScene, multiplier: float, reached: bool) -> Whole:
    rows = made.rounds.scene_rows(made.selection.kept(multiplier).rows)
    return Whole(grid, coded_size(grid, {}), multiplier, rows, reached)
