"""What was asked, of what, and the plan: the record that a command opens once and every step reads."""

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Generic

import numpy as np

from flexgs_edge.cameras.auto import USUAL_COUNT
from flexgs_edge.errors import InputError, TargetError
from flexgs_edge.files import check_writable
from flexgs_edge.goals.promise import MadePoses, Promised
from flexgs_edge.goals.steps import Choice
from flexgs_edge.goals.target import Figure, Target
from flexgs_edge.io.exchange import MovedSource, check_positions, offset_place
from flexgs_edge.io.formats import WRITTEN, Format, written_format
from flexgs_edge.io.frames import RDF
from flexgs_edge.io.model_folder import Companions
from flexgs_edge.io.reading import Reading
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.progress import LOG, SILENT, Progress, Stopwatch
from flexgs_edge.report.run_info import RemovedGroup
from flexgs_edge.run import inputs, view_set
from flexgs_edge.run.open_scene import is_fgs, scene_file
from flexgs_edge.run.options import NO_CAMERAS, NO_PHOTOS, CompressOptions
from flexgs_edge.run.reporter import Reporter
from flexgs_edge.scene.check import without_hidden
from flexgs_edge.scene.source import SceneSource, SelectSource, some_positions
from flexgs_edge.small_matrices import product

EVERYTHING = Choice(0, 0)
LEAST_REFUSED = 1 << 16  # Of smaller inputs, headers alone may make a result larger: there a warning is enough
BEHIND_SHARE = 0.5  # We warn when more than this share of the Gaussians lies behind all cameras
LARGE = 2_000_000
"""Scenes of more Gaussians gain nothing by fine-tuning to automatic views: docs/results/tuning.md#large"""
_SAMPLE_ROWS = 2048
_SAMPLE_VIEWS = 64


@dataclass(frozen=True)
class Output:
    """Where a compressed scene goes."""

    path: Path | None = None  # the file to write; `None` in a dry run
    format: Format | None = None  # another program's format; `None` for a `.fgs`
    offset: np.ndarray | None = None  # [3] f64, how far the scene was moved to zero; `None` if it was not


NO_OUTPUT = Output()  # Of commands that write no scene


@dataclass(frozen=True)
class Plan:
    """Views, target and scores of a run."""

    # Views that decide when the search stops: the held-out views, or the training views with `--select train`.
    decide: list[int]
    # Views that the final figures come from: the held-out views, or the training views if none are held out.
    report: list[int]
    figure: Figure  # the kind of drop that decides: `drop` against photos, else `modelled drop`
    target: Target | None  # `None` for fixed rates
    needs_scores: bool  # whether the method computes importance scores

    @classmethod
    def make(cls, options: CompressOptions, scene: inputs.CheckedScene, views: view_set.ViewSet | None) -> "Plan":
        fixed = options.fixed
        needs_scores = fixed != EVERYTHING and options.method == "paper"
        if views is None:
            if options.clean is not None:
                raise InputError(f"{view_set.WITHOUT_VIEWS}. --clean {options.clean}: views judge what goes")
            if options.method != "paper":
                raise InputError(
                    f"{view_set.WITHOUT_VIEWS}. Views are needed to measure what each Gaussian is worth; without them only "
                    "--method paper with both rates 0 works"
                )
            if fixed is None or needs_scores:
                why = "to score Gaussians and to judge the result" if fixed is None else "to score Gaussians"
                raise InputError(
                    f"{view_set.WITHOUT_VIEWS}. Views are needed {why}; without them only --prune-rate 0 and --sh-rate 0 work"
                )
            return cls([], [], "modelled drop", None, needs_scores)
        if options.select == "test" and not views.held_out:
            raise InputError(
                "--holdout 0 leaves no view to decide on: use --select train as well, or another --holdout"
            )
        if not views.train and (options.method != "paper" or needs_scores or options.select == "train"):
            raise InputError(
                f"{views.cameras_from}: {len(views.cameras)} views, all of them held out (every {options.holdout}th by name): "
                "give more views, or --holdout 0 --select train"
            )
        on_train = options.select == "train"
        figure: Figure = "drop" if views.photos is not None and not on_train else "modelled drop"
        return cls(
            decide=views.train if on_train else views.held_out,
            report=views.held_out or views.train,
            figure=figure,
            target=options.target(figure, scene.ply_bytes),
            needs_scores=needs_scores,
        )

    @property
    def makes_poses(self) -> bool:
        """Whether the promise is about made poses too."""
        target = self.target
        return isinstance(target, Promised) and any(isinstance(part, MadePoses) for part in target.parts)

    @property
    def decided_by(self) -> str | None:
        """Name of the deciding figure: `drop`, `modelled drop`, `fidelity` or `size`; `None` for fixed rates."""
        if self.target is None:
            return None
        return "size" if self.target.limit_bytes is not None else self.target.figure

    @staticmethod
    def kind_of(indices: list[int], views: view_set.ViewSet | None) -> str:
        """Name of the kind of views at `indices`: `held-out`, `training` or `none`."""
        if not indices or views is None:
            return "none"
        return "held-out" if indices == views.held_out else "training"


@dataclass(frozen=True)
class Run(Generic[inputs.Options]):
    """What was asked, and of what. Nothing in it changes."""

    options: inputs.Options  # with near plane, background and antialiasing filled in
    scene: inputs.CheckedScene  # checked
    views: view_set.ViewSet | None  # `None` for `--cameras none`
    plan: Plan | None  # what a run of `compress` needs; `None` for other commands
    budget: MemoryBudget  # one number of bytes for all of it
    clock: Stopwatch  # seconds by stage
    progress: Progress = SILENT  # bars on long work
    reporter: Reporter | None = None  # gathers the pages of `--report`
    output: Output = NO_OUTPUT  # the file that `compress` writes
    judged: inputs.CheckedScene | None = None  # the scene that is compared with this one (`evaluate`)
    background: view_set.Colour | None = None  # before which views are compared, if it is not that of the options
    removed: tuple[RemovedGroup, ...] = ()  # the kinds that `--clean` found
    removed_rows: SceneSource | None = None  # the Gaussians that `--clean` removed
    warnings: tuple[str, ...] = ()  # warnings about how scene and cameras fit together; they are logged already

    @property
    def source(self) -> SceneSource:
        """The scene's values."""
        return self.scene.source

    @property
    def seen(self) -> view_set.ViewSet:
        """The views; raises `InputError` where there are none."""
        if self.views is None:
            raise InputError(view_set.WITHOUT_VIEWS)
        return self.views

    @property
    def target(self) -> Target:
        """What a search aims at."""
        assert self.plan is not None and self.plan.target is not None
        return self.plan.target

    def of_source(self, source: SceneSource) -> "Run[inputs.Options]":
        """The same run on other values."""
        return replace(self, scene=replace(self.scene, source=source))


def open_run(
    path: inputs.ScenePlace,  # a scene file or a model folder, or a scene that is open
    options: inputs.Options,
    progress: Progress = SILENT,
    reporter: Reporter | None = None,
    photos: bool = True,  # look for photos as well as for cameras
    judged_path: inputs.ScenePlace | None = None,
    given: view_set.GivenViews | None = None,  # cameras and photos from memory, instead of those that the options name
    decodes: bool = True,  # the command decodes a `.fgs`; `view` does not, and needs views to look through alone
) -> Run[inputs.Options]:
    """Open a scene with its views (stage `open`).

    `judged_path`: a scene made from this one, which it is compared with. Both are drawn as its file says, and cameras beside it
    are used where this one has none. Raises `InputError` when the scene, its cameras or its photos cannot be used.
    """
    clock = Stopwatch()
    budget = MemoryBudget.from_limit(options.memory_limit)
    with clock.stage("open"):
        companions = _beside(path)
        if judged_path is not None:
            companions = inputs.merge_companions(companions, _beside(judged_path))
        scene = inputs.load_scene(path, options.drop_invalid, replace(options.reading, budget=budget))
        budget.hold(scene.held_bytes)
        if isinstance(options, CompressOptions):
            scene = replace(scene, source=without_hidden(scene.source))
        judged = None
        if judged_path is not None:
            judged = inputs.load_scene(judged_path, options.drop_invalid, Reading(budget=budget))
            budget.hold(judged.held_bytes)
            if judged.crop is not None and scene.crop is None:
                LOG.info("the original is cropped, as %s says", judged_path)
                scene = inputs.load_scene(scene, reading=Reading(crop=judged.crop))
            elif judged.crop is None and scene.crop is not None:
                judged = inputs.load_scene(judged, reading=Reading(crop=scene.crop))
        if scene.crop is not None:
            if options.images not in (None, NO_PHOTOS) or (given is not None and given.images is not None):
                raise InputError("--images: the scene is cropped, and photos show what lies beyond: leave --images out")
            LOG.info("the scene is cropped: it is compared with its own renders, since photos show what lies beyond")
        unread = not decodes and scene.path is not None and is_fgs(scene_file(scene.path))
        would_place = companions.cameras is None and options.cameras is None and options.up is None
        if unread and scene.start is not None and would_place:
            options = replace(options, cameras=NO_CAMERAS)  # the file says where to start: no view has to be placed
        asked = options.near
        options = inputs.resolve_drawing(
            options, judged if judged is not None and judged.settings else scene, companions
        )
        placed = scene.source if decodes else _sample(scene.source)
        views = view_set.find_views(options, companions, placed, photos and scene.crop is None, given, budget)
        found_beside = given is None and options.cameras is None and companions.cameras is not None
        if found_beside and views is not None and scene.start is not None and not scene.start.is_of(views.cameras):
            LOG.warning(
                "warning: %s is not used: %s was made with other cameras. If it belongs to this scene, give it by --cameras",
                *(companions.cameras, scene.path),
            )
            companions = replace(companions, cameras=None, images=None)
            views = view_set.find_views(options, companions, placed, False, None, budget)
        if asked is None and views is not None:
            options, views = view_set.near_enough(options, views)
        found = () if views is None or unread else frame_warnings(views, scene)
        for warning in found:
            LOG.warning("warning: %s", warning)
    return Run(options, scene, views, None, budget, clock, progress, reporter, judged=judged, warnings=found)


def _sample(source: SceneSource) -> SceneSource:
    """A scene from which views are placed in seconds, however large it is: they are only looked through."""
    step = source.count // USUAL_COUNT
    return source if step < 2 else SelectSource(source, np.arange(0, source.count, step))


def planned(run: Run[CompressOptions]) -> Run[CompressOptions]:
    """A run that compresses: raises `InputError` where options, scores and views do not fit together."""
    with run.clock.stage("open"):
        return replace(run, plan=Plan.make(run.options, run.scene, run.views))


def open_compression(
    path: inputs.ScenePlace,
    output: str | os.PathLike[str] | None,
    options: CompressOptions,
    progress: Progress = SILENT,
    given: view_set.GivenViews | None = None,
) -> Run[CompressOptions]:
    """Open what `compress` needs: check its files, open the scene and its views, and plan.

    `output`: The file to write; `None` in a dry run.

    Raises `InputError` when a file cannot be written or read, or the options do not fit together.
    """
    place = check_output(output, options)
    options = replace(options, drop_invalid=options.drop_invalid or options.clean is not None)
    reporter = Reporter.maybe(options.report, options.force)
    run = replace(planned(open_run(path, options, progress, reporter, given=given)), output=place)
    with run.clock.stage("open"):
        if options.background is None and run.views is not None and run.views.photos is None:
            run = _standing_out(run, run.views)
        return _positioned(_affordable(run))


def _affordable(run: Run[CompressOptions]) -> Run[CompressOptions]:
    """The same run, with less work where a large scene gains nothing by more."""
    options, views, count = run.options, run.views, run.source.count
    asked = options.finetunes and options.distil is None and views is not None and views.automatic
    if not asked or count <= LARGE:
        return run
    note = (
        f"{count} Gaussians need so many automatic views that --effort {options.effort} would take long and gain nothing "
        "over fast: this run works as --effort fast. With the scene's cameras (--cameras PATH) it fine-tunes."
    )
    LOG.warning("warning: %s", note)
    return replace(run, options=replace(options, effort="fast"), warnings=(*run.warnings, note))


def _standing_out(run: Run[CompressOptions], views: view_set.ViewSet) -> Run[CompressOptions]:
    """The same run before a background that the scene stands out from."""
    assert run.options.background is not None
    background, note = view_set.contrasting_background(run.source, run.options.background)
    if note is None:
        return run
    return replace(run, background=background, views=replace(views, notes=(*views.notes, note)))


def _positioned(run: Run[CompressOptions]) -> Run[CompressOptions]:
    """The same run with a scene whose positions the format holds: moved to zero with its cameras, if the user asks for it."""
    format, origin = run.output.format, run.source.origin
    if format is None:
        return run
    if run.options.recenter and np.any(origin):
        views = run.views
        if views is not None:
            moved = [
                replace(camera, translation=camera.translation + camera.rotation @ origin) for camera in views.cameras
            ]
            views = replace(views, cameras=moved, close_ups=())
        run = run.of_source(MovedSource(run.source, np.zeros(3)))
        run = replace(run, views=views, output=replace(run.output, offset=origin))
    warnings = check_positions(run.source, format, run.options.force_lossy)
    for warning in warnings:
        LOG.warning("warning: %s", warning)
    return replace(run, warnings=(*run.warnings, *warnings))


def _beside(place: inputs.ScenePlace) -> Companions:
    """What lies beside a scene; nothing beside one from memory."""
    path = place.path if isinstance(place, inputs.CheckedScene) else place
    return Companions() if path is None else inputs.companions_of(path)


def frame_warnings(views: view_set.ViewSet, scene: inputs.CheckedScene) -> tuple[str, ...]:
    """Warn if the scene lies behind the cameras, or out of sight of most: a sample of positions and cameras tells.

    Files of phones often break the rule of their format. Cameras around a scene tell nothing of that, as it lies before some of
    them either way.
    """
    if views.automatic:
        return ()
    means = some_positions(scene.source, _SAMPLE_ROWS)
    behind = np.ones(means.shape[1], bool)
    cameras = views.cameras[:: -(-len(views.cameras) // _SAMPLE_VIEWS)]
    blind = 0
    for camera in cameras:
        x, y, z = product(camera.rotation, means) + camera.translation[:, None]
        behind &= z <= 0
        depth = np.maximum(z, 0.0)
        across, down = camera.fx * x + camera.cx * depth, camera.fy * y + camera.cy * depth
        inside = (across > 0) & (across < camera.width * depth) & (down > 0) & (down < camera.height * depth)
        blind += not inside.any()
    share = float(behind.mean())
    if scene.frame != RDF and share > BEHIND_SHARE:
        return (
            f"{100 * share:.0f} % of the Gaussians lie behind all {len(views.cameras)} cameras of {views.cameras_from}. The "
            f"file's axes were read as {scene.frame.name} (x, y, z) and turned into RDF. Give the right ones with --frame, "
            "such as --frame RDF for a file in the cameras' own frame.",
        )
    if 2 * blind > len(cameras):
        return (
            f"{blind} of {len(cameras)} compared cameras of {views.cameras_from} have nothing of the scene in sight: they look "
            "away from it or are far from it. Are the cameras in the scene's frame?",
        )
    return ()


def check_output(output: str | os.PathLike[str] | None, options: CompressOptions) -> Output:
    """Check every file that a run writes, before any work; raises `InputError` for what cannot be written."""
    format = _foreign_format(output, options)
    if options.score_cache is not None:
        check_writable(options.score_cache, force=True)
    if options.keep_removed is not None:
        if Path(options.keep_removed).suffix.lower() != ".ply":
            raise InputError(f"--keep-removed {options.keep_removed}: expected a name that ends in .ply")
        check_writable(options.keep_removed, options.force)
    if options.dry_run:
        return Output(None, format)
    if output is None:
        raise InputError("-o OUT.fgs is missing: give the file to write, or --dry-run")
    if Path(output).suffix.lower() != ".fgs" and format is None:
        raise InputError(f"-o {output}: expected a name that ends in .fgs, {', '.join(WRITTEN)}")
    check_writable(output, options.force)
    if options.recenter:
        check_writable(offset_place(output), options.force)
    return Output(Path(output), format)


def check_smaller(size: int, input_bytes: int | None, options: CompressOptions) -> None:
    """Raise `TargetError` if a result is larger than the file that came in. `--best-effort` writes it all the same."""
    if input_bytes is not None and size > input_bytes > LEAST_REFUSED and not options.best_effort:
        method = " leave --method paper out," if options.method == "paper" else ""
        raise TargetError(
            f"the result would have {size} bytes, and the input has {input_bytes}: nothing was written. Keep the input, or"
            f"{method} ask for less: --max-size {input_bytes}, or a larger --max-drop. --best-effort writes it all the same"
        )


def _foreign_format(output: str | os.PathLike[str] | None, options: CompressOptions) -> Format | None:
    """The format that `-o` asks for, if the options fit it; `None` for `.fgs`."""
    format = None if output is None else written_format(output, options.writing)
    if format is None:
        if options.recenter or options.force_lossy:
            word = "recenter" if options.recenter else "force-lossy"
            raise InputError(f"--{word}: a .fgs holds scenes far from zero as they are; leave it out")
        return None
    if options.method == "paper":
        raise InputError(f"--method paper writes .fgs files alone, not {format.suffix}; leave it out, or write a .fgs")
    if options.layers is not None and options.layers > 1:
        raise InputError(f"--layers {options.layers}: {format.suffix} has no layers; leave it out, or write a .fgs")
    if options.preview:
        raise InputError(f"--preview {options.preview}: {format.suffix} has no preview; leave it out, or write a .fgs")
    if options.resume or options.scratch is not None:
        raise InputError(
            f"--{'resume' if options.resume else 'scratch'} works on .fgs files alone: the search for a "
            f"{format.suffix} is in memory and in one go; leave it out"
        )
    return format
