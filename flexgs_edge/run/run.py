"""What was asked, and of what: the record that a command opens once and every step reads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic

from flexgs_edge.errors import InputError
from flexgs_edge.goals.target import Target
from flexgs_edge.io.model_folder import Companions
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.run.clock import Stopwatch
from flexgs_edge.run.companions import companions_of, merge_companions
from flexgs_edge.run.inputs import CheckedScene, Options, ScenePlace, load_scene, resolve_drawing
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.plan import Plan
from flexgs_edge.run.reporter import Reporter
from flexgs_edge.run.view_set import WITHOUT_VIEWS, GivenViews, ViewSet, find_views
from flexgs_edge.scene.source import SceneSource


@dataclass(frozen=True)
class Run(Generic[Options]):
    """What was asked, and of what. Nothing in it changes.

    Parameters
    ----------
    options : ViewOptions
        With near plane, background, extent and antialiasing filled in.
    scene : CheckedScene
        Checked.
    views : ViewSet or None
        `None` for `--cameras none`.
    plan : Plan or None
        What a run of `compress` needs; `None` for other commands.
    budget : MemoryBudget
        One number of bytes for all of it.
    clock : Stopwatch
        Seconds by stage.
    progress : Progress
        Bars on long work.
    reporter : Reporter or None
        Gathers the pages of `--report`.
    made : CheckedScene or None
        A scene made from this one, where that is what a command looks at.
    """

    options: Options
    scene: CheckedScene
    views: ViewSet | None
    plan: Plan | None
    budget: MemoryBudget
    clock: Stopwatch
    progress: Progress = SILENT
    reporter: Reporter | None = None
    made: CheckedScene | None = None

    @property
    def source(self) -> SceneSource:
        """The scene's values."""
        return self.scene.source

    @property
    def seen(self) -> ViewSet:
        """The views; raises `InputError` where there are none."""
        if self.views is None:
            raise InputError(WITHOUT_VIEWS)
        return self.views

    @property
    def target(self) -> Target:
        """What a search aims at."""
        assert self.plan is not None and self.plan.target is not None
        return self.plan.target

    def aimed_at(self, target: Target) -> Run[Options]:
        """The same run with another target."""
        assert self.plan is not None
        return replace(self, plan=replace(self.plan, target=target))

    def of_source(self, source: SceneSource) -> Run[Options]:
        """The same run on other values."""
        return replace(self, scene=replace(self.scene, source=source))


def open_run(
    path: ScenePlace,
    options: Options,
    progress: Progress = SILENT,
    reporter: Reporter | None = None,
    photos: bool = True,
    drawn_as: ScenePlace | None = None,
    given: GivenViews | None = None,
) -> Run[Options]:
    """Open a scene with its views (stage `open`).

    Parameters
    ----------
    path : path or CheckedScene
        A scene file or a model folder, or a scene that is open.
    photos : bool
        Look for photos as well as for cameras.
    drawn_as : path or CheckedScene, optional
        A scene made from this one: it is drawn as its file says, and cameras beside it are used where this one has none.
    given : GivenViews, optional
        Cameras and photos from memory, instead of those that the options name.

    Raises
    ------
    InputError
        When the scene, its cameras or its photos cannot be used.
    """
    clock = Stopwatch()
    budget = MemoryBudget.from_limit(options.memory_limit)
    with clock.stage("open"):
        companions = _beside(path)
        if drawn_as is not None:
            companions = merge_companions(companions, _beside(drawn_as))
        scene = load_scene(path, options.drop_invalid)
        made = None if drawn_as is None else load_scene(drawn_as, options.drop_invalid)
        options = resolve_drawing(options, made if made is not None and made.settings else scene, companions)
        views = find_views(options, companions, scene.source, photos, given)
    return Run(options, scene, views, None, budget, clock, progress, reporter, made)


def open_planned(
    path: ScenePlace,
    options: CompressOptions,
    progress: Progress = SILENT,
    reporter: Reporter | None = None,
    check: Callable[[Run[CompressOptions]], object] | None = None,
    given: GivenViews | None = None,
) -> Run[CompressOptions]:
    """`open_run` for what compresses: the words of the options, the scores and the views must fit together.

    `check` is called in stage `open`, before any work.
    """
    run = open_run(path, options, progress, reporter, given=given)
    with run.clock.stage("open"):
        run = replace(run, plan=Plan.make(run.options, run.scene, run.views))
        if check is not None:
            check(run)
        if reporter is not None and run.views is not None:
            reporter.see_cameras(run.views, run.scene)
    return run


def _beside(place: ScenePlace) -> Companions:
    """What lies beside a scene; nothing beside one from memory."""
    path = place.path if isinstance(place, CheckedScene) else place
    return Companions() if path is None else companions_of(path)
