"""A scene of a study: opened and scored once, then measured at any setting.

Each setting is measured once and remembered, because several experiments ask for the same ones.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from flexgs_edge.goals.steps import Choice, SearchResult, Step
from flexgs_edge.goals.target import Measurement, Target
from flexgs_edge.methods.paper.method import Ranked, SceneEvaluator, score_scene
from flexgs_edge.methods.paper.prune import nonzero_sh, order_from_scores
from flexgs_edge.methods.paper.search import adapt
from flexgs_edge.packed.bitpack import PAPER, BitSpec
from flexgs_edge.progress import Progress
from flexgs_edge.quality.psnr import mse_of_psnr
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.run.open_renderer import open_renderer
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.quality_evaluator import QualityEvaluator
from flexgs_edge.run.run import EVERYTHING, Plan, Run, open_run, planned
from flexgs_edge.run.view_set import ViewSet
from flexgs_edge.studies.written import Cell, figures

LOG = logging.getLogger("flexgs_edge")

RANK_BYTES = 24  # Bytes for each row and score: order, rank, and the number of rows with SH above each rank


@dataclass(frozen=True)
class Setting:
    """How a scene is compressed: rates, bits, groups a channel, and the score that ranks its rows."""

    choice: Choice = EVERYTHING
    bits: BitSpec = PAPER
    groups: int | None = None
    score: str = "gs"


@dataclass(frozen=True)
class Point:
    """A setting, its exact bytes and its measured quality."""

    setting: Setting
    size: int
    measurement: Measurement


class StudyScene:
    """A scene, its judge and everything measured so far."""

    def __init__(
        self,
        name: str,  # name of the scene, for tables and folders
        run: Run[CompressOptions],  # As for `compress`. The plan's views and figure decide here too.
        renderer: Renderer,  # draws the views
        judge: QualityEvaluator,  # prepared, with the original's renders
        orders: dict[str, np.ndarray],  # [N] i64 by name of the score: rows, least important first
        has_sh: np.ndarray,  # [N] bool, rows with SH that are not zero
    ) -> None:
        self.name, self.run, self.renderer, self.judge, self.orders, self.has_sh = (
            name,
            run,
            renderer,
            judge,
            orders,
            has_sh,
        )
        self._evaluators: dict[str, SceneEvaluator] = {}
        self._points: dict[Setting, Point] = {}
        self._search: SearchResult | None = None

    @property
    def plan(self) -> Plan:
        """Which views and which figure decide."""
        assert self.run.plan is not None
        return self.run.plan

    @property
    def views(self) -> ViewSet:
        """All views."""
        return self.run.seen

    @property
    def target(self) -> Target:
        """The target of this study's search."""
        return self.run.target

    @property
    def figure(self) -> str:
        """Name of the column that decides: `drop` with photos, else `modelled_drop`."""
        return self.plan.figure.replace(" ", "_")

    @property
    def decided_by(self) -> str:
        """The deciding figure and its views, in words."""
        views = f"{len(self.plan.decide)} {self.plan.kind_of(self.plan.decide, self.views)} views"
        if self.plan.figure == "drop":
            return f"drop in PSNR against the photos, mean over {views}"
        return (
            f"modelled drop (no photos: error against the original's renders, from a base of {self.judge.base_psnr:g} dB), "
            f"over {views}"
        )

    def ranked(self, order: np.ndarray) -> Ranked:
        """The scene with its rows in another order ([N] i64, least important first)."""
        return Ranked(self.run.source, order, self.has_sh)

    def evaluator(self, setting: Setting) -> SceneEvaluator:
        """The evaluator of `compress`, with the bits, groups and score of `setting`. The next call changes it."""
        if setting.score not in self._evaluators:
            self._evaluators[setting.score] = SceneEvaluator(
                self.ranked(self.orders[setting.score]), setting.bits, setting.groups, self.judge, self.run.budget
            )
        evaluator = self._evaluators[setting.score]
        evaluator.bits, evaluator.groups = setting.bits, setting.groups
        return evaluator

    def size(self, setting: Setting) -> int:
        """Exact bytes of the file. Nothing is measured."""
        return self.evaluator(setting).size(setting.choice)

    def point(self, setting: Setting) -> Point:
        """Measure a setting, unless it was measured before."""
        if setting not in self._points:
            found = self.evaluator(setting).measure(setting.choice)
            self._points[setting] = Point(setting, self.size(setting), found)
        return self._points[setting]

    def points(self, settings: Sequence[Setting], label: str) -> list[Point]:
        """Measure several settings, with a progress bar."""
        return [self.point(setting) for setting in self.run.progress.track(settings, label, len(settings))]

    def adapt(self, target: Target, on_step: Callable[[Step], None] | None = None) -> SearchResult:
        """Search for `target` as the paper does, with remembered points; the closest point if nothing holds."""
        return adapt(_Remembering(self), target, self.run.options.effort, best_effort=True, on_step=on_step)

    @property
    def search(self) -> SearchResult:
        """The search for the study's own target. It runs at the first use."""
        if self._search is None:
            self._search = self.adapt(self.target)
        return self._search

    def figures(self, size: int, found: Measurement) -> dict[str, Cell]:
        """Cells of the columns `FIGURES`."""
        return figures(size, self.run.scene.ply_bytes, found)

    def cells(self, point: Point) -> dict[str, Cell]:
        """Cells of the columns `FIGURES` for a point."""
        return self.figures(point.size, point.measurement)

    def error(self, point: Point) -> float:
        """Mean squared error against the original's renders, averaged over the views."""
        return mse_of_psnr(self.judge.base_psnr) * (float(10.0 ** (point.measurement.modelled_drop / 10.0)) - 1.0)


class _Remembering:
    """The evaluator for a search. It measures nothing that the study has measured before."""

    def __init__(self, studied: StudyScene) -> None:
        self.studied = studied

    def size(self, choice: Choice) -> int:
        return self.studied.size(Setting(choice))

    def measure(self, choice: Choice) -> Measurement:
        return self.studied.point(Setting(choice)).measurement

    def estimate(self, choice: Choice) -> Measurement:
        return self.studied.evaluator(Setting()).estimate(choice)


@contextmanager
def open_study_scene(
    path: str | Path, name: str, options: CompressOptions, progress: Progress, scores: Sequence[str] = ("gs",)
) -> Iterator[StudyScene]:
    """Open a scene, draw the original's renders and score every Gaussian, as `compress --method paper` does.

    Raises `FlexGSError`: As `compress`.
    """
    # Studies compare methods by the mean alone, each with the poses that it is given.
    options = replace(options, promise="mean")
    # Planning refuses scenes without cameras, and splits without training poses, as `compress` does.
    run = planned(open_run(path, options, progress))
    source, views, plan, clock = run.source, run.seen, run.plan, run.clock
    assert plan is not None
    with clock.stage("open"):
        has_sh = nonzero_sh(source)
    with ExitStack() as stack:
        renderer = stack.enter_context(open_renderer(run))
        run.budget.take("ranks", RANK_BYTES * source.count * len(scores))
        judge = QualityEvaluator(
            renderer, source, views, plan.decide, plan.figure == "drop", base_psnr=options.base_psnr
        )
        stack.callback(judge.close)
        with clock.stage("load"):
            original = renderer.load(source)
        orders = {}
        with original:
            with clock.stage("references"):
                judge.prepare(original, progress)
            cameras = views.of(views.train)
            for score in scores:
                LOG.info("%s: %s scores over %d training poses", name, score, len(cameras))
                with clock.stage(f"score {score}"):
                    found = score_scene(renderer, original, source, cameras, score, progress)
                    orders[score] = order_from_scores(found)
        renderer.release()
        yield StudyScene(name, run, renderer, judge, orders, has_sh)


def beside(what: str, here: str, paper: str) -> str:
    """A figure measured here beside the published one, in words."""
    return f"{what}: {here}; paper: {paper}"
