"""Runs the method best for experiments: at a target."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.codec.v2.container import coded_size
from flexgs_edge.goals.steps import Choice
from flexgs_edge.goals.target import Measurement, Target
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.grid.values import from_grid
from flexgs_edge.methods.best.grid_coder import GridCoder
from flexgs_edge.methods.best.grid_maker import GridMaker
from flexgs_edge.methods.best.method import grid_maker, open_rounds
from flexgs_edge.methods.best.poses import scored_poses
from flexgs_edge.methods.best.rounds import PruneRounds
from flexgs_edge.methods.best.search import search as search_by
from flexgs_edge.methods.paper.evaluator import SceneEvaluator
from flexgs_edge.packed.bitspec import BitSpec
from flexgs_edge.quality.psnr import modelled_drop
from flexgs_edge.quality.view_quality import Quality, ViewQuality
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.report.plots import Series
from flexgs_edge.run.quality_evaluator import QualityEvaluator, measurement_of
from flexgs_edge.scene.source import MemorySource, SceneSource
from flexgs_edge.studies.paper.pruning import nearest
from flexgs_edge.studies.result_tables import Row
from flexgs_edge.studies.study_scene import Setting, StudyScene

BREAK = 3.0  # A method has broken if it loses more than this, in dB: twice the squared error
LOST = f"lost {BREAK:g} dB"
BEST, PAPER, RTN, ROWS, SH = "best", "paper", "RTN, 8 bits", "rows only", "SH only"
MARGIN = "best, --views-margin"
WORDS = (
    f"best and paper: the results at the study's target. {MARGIN}: generated poses are scored too. {RTN}: one "
    f"range a channel, nothing removed. {ROWS}, {SH}: the paper's bits, with only Gaussians or only SH removed by gs, to "
    "paper's bytes or as near as possible."
)


def view_loss(studied: StudyScene, view: ViewQuality) -> float:
    """Loss of one view in dB, in the figure that decides: its drop against the photo, or its modelled drop."""
    if studied.plan.figure == "drop" and view.loss is not None:
        return view.loss
    error = view.covered_error or 0.0 if studied.judge.covered_decides else view.error
    return modelled_drop(error, studied.judge.base_psnr)


def mean_loss(studied: StudyScene, views: Sequence[ViewQuality]) -> float:
    """Mean loss of some views in the figure that decides, dB."""
    if studied.plan.figure == "drop":
        return math.fsum(view_loss(studied, view) for view in views) / len(views)
    base_psnr = studied.judge.base_psnr
    return modelled_drop(Quality(tuple(views), covered_decides=studied.judge.covered_decides).deciding_error, base_psnr)


@contextmanager
def drawn(studied: StudyScene, evaluator: SceneEvaluator, choice: Choice) -> Iterator[DeviceScene]:
    """The scene of a choice, quantized and loaded."""
    with evaluator.quantized(choice) as quantized, studied.context.renderer.load_quantized(quantized) as scene:
        yield scene


def number(row: Row, column: str) -> float:
    """The number in a cell."""
    value = row[column]
    assert isinstance(value, (int, float)), f"{column}: {value!r}"
    return float(value)


def curve(rows: Sequence[Row], label: str, x: str, y: str = "loss", line: bool = True, every: bool = False) -> Series:
    """Rows as a series of a chart. Its first break is marked, or with `every` all breaks. Points with an error have no y."""
    shown = [row for row in rows if row[x] is not None]
    broken = [number(row, x) for row in shown if row["broke"] is not None]
    return Series(
        label,
        [number(row, x) for row in shown],
        [None if row[y] is None else number(row, y) for row in shown],
        line=line,
        broken=broken if every else broken[:1],
    )


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
    studied: StudyScene, source: SceneSource, cameras: Sequence[Camera], margin: bool = False
) -> Iterator[PruneRounds]:
    """Open rounds of pruning over some poses (with `margin`, also generated ones), for any number of searches."""
    options, context = replace(studied.run.options, views_margin=margin), studied.context
    run = replace(studied.run.of_source(source), options=options)
    poses = scored_poses(cameras, options, context.renderer, source, studied.judge.covered_decides)
    with open_rounds(run, context, poses.cameras, known=poses.known) as rounds:
        yield rounds


def search(studied: StudyScene, rounds: PruneRounds, target: Target, judge: QualityEvaluator | None = None) -> Whole:
    """Search for a target; the closest candidate if none meets it."""
    judge = judge or studied.judge
    made = _search(studied, rounds, judge, rounds.original.context.renderer)
    with studied.run.clock.stage("search"):
        found = search_by(made, target, best_effort=True)
    multiplier = found.chosen.multiplier
    return _whole(made, found.product, multiplier, found.reached)


def _search(studied: StudyScene, rounds: PruneRounds, judge: QualityEvaluator, renderer: Renderer) -> GridMaker:
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


class Contenders:
    """The compressed scenes, by name.

    `studied`: the scene. `ours`: the result of best. `guarded`: the result of best with generated poses
    (`--views-margin`).
    """

    def __init__(self, studied: StudyScene, ours: Whole, guarded: Whole) -> None:
        self.studied, self.wholes = studied, {BEST: ours, MARGIN: guarded}
        paper = Setting(studied.search.chosen.choice)
        size = studied.size(paper)
        self.settings = {
            PAPER: paper,
            RTN: Setting(bits=BitSpec.rtn(8), groups=1),
            ROWS: Setting(_of_size(studied, size, lambda rate: Choice(min(rate, 980), 0))),
            SH: Setting(_of_size(studied, size, lambda rate: Choice(0, rate))),
        }
        self.names = (*self.wholes, *self.settings)

    def size(self, name: str) -> int:
        """Bytes of the file."""
        return self.wholes[name].size if name in self.wholes else self.studied.size(self.settings[name])

    @contextmanager
    def loaded(self, name: str) -> Iterator[DeviceScene]:
        """The decoded scene of its file, loaded to draw."""
        if name in self.wholes:
            with self.studied.context.renderer.load(self.wholes[name].source) as scene:
                yield scene
        else:
            setting = self.settings[name]
            with drawn(self.studied, self.studied.evaluator(setting), setting.choice) as scene:
                yield scene


def _of_size(studied: StudyScene, size: int, choice: Callable[[int], Choice]) -> Choice:
    ladder = [choice(rate) for rate in range(1001)]
    sizes = [studied.size(Setting(one)) for one in ladder]
    place = nearest(sizes, size)
    # If a size is out of reach, the nearer end counts.
    return ladder[place] if place is not None else ladder[-1 if size < sizes[-1] else 0]
