"""`compress`: open, score, search, write, and measure what was written."""

from __future__ import annotations

import logging
import os
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge.codec.open_fgs import open_fgs
from flexgs_edge.codec.v1.container import write_container
from flexgs_edge.codec.v1.packed_source import FgsSource
from flexgs_edge.errors import InputError, TargetError
from flexgs_edge.files import temporary_name
from flexgs_edge.goals.choice import Choice
from flexgs_edge.goals.steps import SearchResult, Step, step_words
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.grid.values import values_of
from flexgs_edge.io.exchange import read_foreign
from flexgs_edge.io.formats import Format
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.memory.storage import IN_MEMORY, Storage
from flexgs_edge.methods.best.checkpoint import open_checkpoint
from flexgs_edge.methods.best.grid_coder import GridCoder
from flexgs_edge.methods.best.keep import kept_as_it_is
from flexgs_edge.methods.best.method import grid_search, layered, search_best
from flexgs_edge.methods.best.poses import scored_poses
from flexgs_edge.methods.best.spill import choose_storage, prepare_memory
from flexgs_edge.methods.foreign.file_maker import WrittenFile, open_files, publish
from flexgs_edge.methods.foreign.method import search_files
from flexgs_edge.methods.paper.auto_bits import bits_by_sensitivity
from flexgs_edge.methods.paper.evaluator import SceneEvaluator
from flexgs_edge.methods.paper.prune import nonzero_sh, order_from_scores
from flexgs_edge.methods.paper.score_cache import ScoreCache
from flexgs_edge.methods.paper.score_files import load_scores, save_scores
from flexgs_edge.methods.paper.scores import score_scene
from flexgs_edge.methods.paper.search import adapt, measure_fixed
from flexgs_edge.packed.bitspec import PAPER, BitSpec
from flexgs_edge.packed.quantize import QuantizedScene
from flexgs_edge.packed.sensitivity import Sensitivity
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.quality.view_quality import Quality
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.report.results import CompressResult
from flexgs_edge.run.clock import Stopwatch
from flexgs_edge.run.companions import companions_of
from flexgs_edge.run.decoding import ahead, coding_device, decoded
from flexgs_edge.run.doubts import TrainingPoses, doubts
from flexgs_edge.run.fingerprint import fingerprint
from flexgs_edge.run.inputs import Scene, load_scene, resolve_drawing, scene_info
from flexgs_edge.run.judge import Judge
from flexgs_edge.run.open_bench import Workspace, run_info
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.outputs import check_outputs, foreign_format
from flexgs_edge.run.plan import Plan
from flexgs_edge.run.reporter import Reporter
from flexgs_edge.run.settings import make_settings
from flexgs_edge.run.view_set import ViewSet, find_views, views_info
from flexgs_edge.scene.source import MemorySource, SceneSource
from flexgs_edge.units import format_size

LOG = logging.getLogger("flexgs_edge")


def compress(
    input: str | Path,
    output: str | Path | None,
    options: CompressOptions | None = None,
    progress: Progress = SILENT,
    **words: Any,
) -> CompressResult:
    """Compress a scene to the fewest bytes that hold a target.

    Parameters
    ----------
    input : path
        A scene file (`.ply`, `.fgs`, `.spz`, `.sog`, `.compressed.ply`), or INRIA's model folder.
    output : path or None
        The `.fgs`, `.spz`, `.sog` or `.compressed.ply` to write (None, for a `.fgs`, only in a dry run).
    options : CompressOptions, optional
        What the command line would say.
    progress : Progress, optional
        Bars on long work.
    **words
        Single options by the names of `CompressOptions`, such as `max_drop=0.5`.

    Returns
    -------
    CompressResult
        Sizes, quality of the decoded file, every step of the search, times.

    Raises
    ------
    FlexGSError
        `InputError`, `TargetError`, `DeviceError` or `BudgetError`; nothing is left behind then.
    """
    options = replace(options or CompressOptions(), **words)
    format = foreign_format(output, options)
    target_path = check_outputs(output, options)
    reporter = Reporter.maybe(options.report, options.force)
    clock = Stopwatch()
    budget = MemoryBudget.from_limit(options.memory_limit)
    with clock.stage("open"):
        companions = companions_of(input)
        scene = load_scene(input, options.drop_invalid)
        options = resolve_drawing(options, scene, companions)
        views = find_views(options, companions, scene.source)
        # Before any work: the words of the scores file and of the views must fit together.
        plan = Plan.make(options, scene, views)
        prepare_memory(scene.source, options, budget)
        scores = (
            None if plan.computes_scores or not plan.needs_scores else load_scores(options.score, scene.source.count)
        )
        if reporter is not None and views is not None:
            reporter.see_cameras(views, scene)
    with ExitStack() as stack:
        workspace = None if views is None else stack.enter_context(Workspace(options, budget, clock, options.cluster))
        if reporter is not None and views is not None:
            reporter.reserve(budget, views, plan.report)
        job = _Job(stack, options, scene, views, plan, budget, clock, workspace, progress, reporter, format)
        result = job.run(target_path, scores)
    if reporter is not None:
        if target_path is not None and format is None:
            reporter.read_contents(target_path)
        reporter.write(result, plan.target)
    return result


class _Job:
    """One run of `compress`, stage by stage."""

    def __init__(
        self,
        held: ExitStack,
        options: CompressOptions,
        scene: Scene,
        views: ViewSet | None,
        plan: Plan,
        budget: MemoryBudget,
        clock: Stopwatch,
        workspace: Workspace | None,
        progress: Progress,
        reporter: Reporter | None = None,
        format: Format | None = None,
    ) -> None:
        self.held, self.reporter, self.format = held, reporter, format
        self.options, self.scene, self.views, self.plan = options, scene, views, plan
        self.budget, self.clock, self.workspace, self.progress = budget, clock, workspace, progress
        self.source = scene.source
        self.groups = options.bit_spec()[1]
        self.sensitivity: list[Sensitivity] = []
        self.scores_reused = False
        self.storage: Storage = IN_MEMORY
        self.training: TrainingPoses | None = None
        self.trained: float | None = None

    def run(self, output: Path | None, scores: np.ndarray | None) -> CompressResult:
        """The whole job; `scores` come from a file, or are computed."""
        decide, report = self._judges()
        if self.options.method == "best":
            return self._run_best(output, decide, report)
        cache = self._score_cache()
        if cache is not None:
            scores = cache.load(self.source.count)
            self.scores_reused = scores is not None
            LOG.info("scores %s %s", "reused from" if self.scores_reused else "will be kept in", cache.path)
        if self.workspace is not None:
            scores = self._look_at_original(decide, report, scores)
        if cache is not None and scores is not None and not self.scores_reused:
            cache.save(scores)
        if self.options.save_scores is not None and scores is not None:
            save_scores(self.options.save_scores, scores, self.options.force)
        order = np.arange(self.source.count) if scores is None else order_from_scores(scores)
        if self.format is not None:
            return self._run_files(self.format, output, order, decide, report)
        with self.clock.stage("open"):
            has_sh = nonzero_sh(self.source)
        evaluator = self._evaluator(order, has_sh, PAPER, decide)
        bits, _ = self.options.bit_spec()
        if bits is None:
            with self.clock.stage("sensitivity"):
                bits, self.sensitivity = bits_by_sensitivity(
                    evaluator, self.views, self.options.base_psnr, self.progress
                )
        evaluator.bits = bits
        with self.clock.stage("search"):
            search = self._search(evaluator)
        if decide is not None and decide is not report:
            decide.close()
        choice = search.chosen.choice if search else self.options.fixed
        assert choice is not None
        with evaluator.quantized(choice) as quantized:
            quality = self._write(output, quantized, search, report)
        return self._result(output, evaluator.size(choice), choice, quantized, search, quality)

    def _score_cache(self) -> ScoreCache | None:
        """The file of kept scores, for what is scored in this run."""
        options = self.options
        if options.score_cache is None or not self.plan.computes_scores:
            return None
        assert self.views is not None and options.near is not None and options.extent is not None
        with self.clock.stage("fingerprint"):
            cameras = self.views.of(self.views.train)
            key = fingerprint(
                self.source, cameras, options.score, options.near, options.extent, bool(options.antialiased)
            )
        return ScoreCache(options.score_cache, key)

    def _run_best(self, output: Path | None, decide: Judge | None, report: Judge | None) -> CompressResult:
        """The job by measured costs: see `flexgs_edge.methods.best.method`."""
        options, plan = self.options, self.plan
        assert self.workspace is not None and self.views is not None and plan.target is not None
        assert decide is not None and report is not None
        renderer = self.workspace.renderer
        if self.format is not None:
            if options.resume or options.scratch is not None:
                raise InputError(
                    f"--{'resume' if options.resume else 'scratch'} works on .fgs files alone: the search for a "
                    f"{self.format.suffix} is in memory and in one go; leave it out"
                )
            self._look_at_original(decide, report, None)
            return self._run_files(self.format, output, None, decide, report)
        poses = scored_poses(self.views.of(self.views.train), options, renderer, self.source)
        folder = Path(options.scratch or (tempfile.gettempdir() if output is None else output.parent))
        storage = choose_storage(renderer, self.source, poses.cameras, options, self.budget, folder)
        self.storage = renderer.storage = storage
        self._look_at_original(decide, report, None)
        kept = None
        if options.resume:
            with self.clock.stage("fingerprint"):
                kept = open_checkpoint(renderer, self.source, poses.cameras, options, folder)
        LOG.info("searching for %s", plan.target.describe())
        coder = GridCoder(renderer)
        settings_of = partial(make_settings, options, plan, self.scene, self.views, bits=None)
        with self.clock.stage("search"):
            found = kept_as_it_is(coder, renderer, self.source, decide, plan.target, options, self.budget, settings_of)
        grid, search = found or search_best(
            grid_search(options, coder),
            renderer,
            self.source,
            poses,
            decide,
            plan.target,
            options,
            self.budget,
            self.clock,
            on_step=lambda step: LOG.info("%s", step_words(step, plan.target)),
            progress=self.progress,
            checkpoint=kept,
        )
        if decide is not report:
            decide.close()
        if options.layers > 1:
            with self.clock.stage("layers"):
                grid = layered(grid, renderer, poses, options, self.progress)
        settings = settings_of(search)
        if output is None:
            if self.reporter is not None:
                self.reporter.read_contents_of(lambda place: coder.write(place, grid, settings))
            size = coder.size(grid, settings)
            quality = self._measure_source(MemorySource(values_of(grid, storage), origin=grid.origin), report)
        else:
            with temporary_name(output, options.force, None if kept is None else kept.key) as place:
                with self.clock.stage("write"):
                    size = coder.write(place, grid, settings)
                if search.reached and plan.target.limit_bytes is not None and size > plan.target.limit_bytes:
                    raise TargetError(
                        f"{plan.target.describe()}: {options.layers} layers make the file {size} bytes; ask for fewer layers"
                    )
                quality = self._measure_source(decoded(open_fgs(place), renderer), report)
            LOG.info("wrote %s, %s", output, format_size(size))
        if kept is not None:
            kept.remove()
        storage.close()
        return self._result(output, size, search.chosen.choice, grid, search, quality)

    def _run_files(
        self,
        format: Format,
        output: Path | None,
        order: np.ndarray | None,
        decide: Judge | None,
        report: Judge | None,
    ) -> CompressResult:
        """The job for another program's format, in rank order or (`order` None) by measured costs: see `pipeline.foreign`."""
        options, plan = self.options, self.plan
        renderer = self.workspace.renderer if self.workspace else None
        if options.antialiased:
            LOG.warning("%s does not say that the model is antialiased: viewers must be told", format.suffix)
        poses = None
        if order is None and renderer is not None and self.views is not None:
            poses = scored_poses(self.views.of(self.views.train), options, renderer, self.source)
        with open_files(format, output, options.force, self.budget, renderer, decide) as files:
            if plan.target is not None:
                LOG.info("searching for %s", plan.target.describe())
            file, search = search_files(
                files, order, renderer, self.source, poses, decide, plan.target, options, self.budget, self.clock,
                on_step=lambda step: LOG.info("%s", step_words(step, plan.target)), progress=self.progress,
            )  # fmt: skip
            if decide is not None and decide is not report:
                decide.close()
            quality = None if report is None else self._measure_source(read_foreign(file.path), report)
            if output is not None:
                publish(file, output, options.force)
                LOG.info("wrote %s, %s", output, format_size(file.size))
        return self._result(output, file.size, search.chosen.choice, file, search, quality)

    def _measure_source(self, source: SceneSource, report: Judge) -> Quality:
        assert self.workspace is not None
        renderer = self.workspace.renderer
        with ahead(source, self.budget, coding_device(renderer.backend, self.budget, source.count, source.sh_degree)):
            return self._compare(lambda: renderer.load(source), report)

    def _judges(self) -> tuple[Judge | None, Judge | None]:
        """The judge that decides and the one that reports; one and the same unless the training poses decide."""
        if self.workspace is None or self.views is None:
            return None, None

        def judge(indices: list[int], reports: bool) -> Judge:
            assert self.workspace is not None and self.views is not None
            shared = (self.workspace.renderer, self.source, self.views, indices, self.budget)
            return Judge(*shared, with_photos=reports, base_psnr=self.options.base_psnr, reports=reports)

        report = judge(self.plan.report, True)
        on_train = self.plan.decide != self.plan.report
        return (judge(self.plan.decide, False) if on_train else report), report

    def _look_at_original(
        self, decide: Judge | None, report: Judge | None, scores: np.ndarray | None
    ) -> np.ndarray | None:
        """Reference renders and scores, with the original loaded once."""
        assert self.workspace is not None and self.views is not None and decide is not None and report is not None
        renderer = self.workspace.renderer
        with self.clock.stage("load"):
            device_scene = renderer.load(self.source)
        with device_scene:
            with self.clock.stage("references"):
                report.prepare(device_scene, self.progress)
                if decide is not report:
                    decide.prepare(device_scene, self.progress)
                if self.views.train and self.plan.report == self.views.held_out:
                    training = self.views.of(self.views.train)
                    self.training = TrainingPoses(renderer, device_scene, training, self.progress)
                    self.held.callback(self.training.close)
            if self.plan.computes_scores and scores is None:
                cameras = self.views.of(self.views.train)
                LOG.info("scoring %d Gaussians over %d training poses", self.source.count, len(cameras))
                with self.clock.stage("score"):
                    scores = score_scene(
                        renderer, device_scene, self.source, cameras, self.options.score, self.progress
                    )
        renderer.release()
        return scores

    def _evaluator(self, order: np.ndarray, has_sh: np.ndarray, bits: BitSpec, judge: Judge | None) -> SceneEvaluator:
        renderer = self.workspace.renderer if self.workspace else None
        return SceneEvaluator(self.source, order, has_sh, bits, self.groups, renderer, judge, self.budget)

    def _search(self, evaluator: SceneEvaluator) -> SearchResult | None:
        fixed = self.options.fixed
        if evaluator.judge is None:
            return None
        if fixed is not None:
            return measure_fixed(evaluator, fixed)
        assert self.plan.target is not None
        LOG.info("searching for %s", self.plan.target.describe())

        def on_step(step: Step) -> None:
            LOG.info("%s", step_words(step, self.plan.target))

        return adapt(evaluator, self.plan.target, self.options.effort, self.options.best_effort, on_step)

    def _write(
        self, output: Path | None, quantized: QuantizedScene, search: SearchResult | None, report: Judge | None
    ) -> Quality | None:
        """Write the file under another name, measure what it decodes to, and only then give it its name."""
        settings = make_settings(self.options, self.plan, self.scene, self.views, search, quantized.bits)
        if output is None:
            if self.reporter is not None:
                self.reporter.read_contents_of(lambda place: write_container(place, quantized, settings))
            return self._measure(quantized, report)
        with temporary_name(output, self.options.force) as place:
            with self.clock.stage("write"):
                size = write_container(place, quantized, settings)
            quality = None
            if report is not None:
                self.budget.take("the decoded file", size)
                quality = self._measure(FgsSource(place).quantized(), report)
                self.budget.give(size)
        LOG.info("wrote %s, %s", output, format_size(size))
        return quality

    def _measure(self, quantized: QuantizedScene, report: Judge | None) -> Quality | None:
        if self.workspace is None or report is None:
            return None
        renderer = self.workspace.renderer
        return self._compare(lambda: renderer.load_quantized(quantized), report)

    def _compare(self, load: Callable[[], DeviceScene], report: Judge) -> Quality:
        """Quality of what `load` brings to the device, over the views that report and (fidelity only) some training poses."""
        with self.clock.stage("measure"), load() as scene:
            # First, since it brings the scene to the backend: the judge then sees whether it is what the search measured.
            if self.training is not None:
                self.trained = self.training.fidelity(scene)
            quality = report.compare(scene, with_ssim=True, progress=self.progress)
            if self.reporter is not None:
                self.reporter.look(report, scene, quality, self.clock, self.progress)
        return quality

    def _result(
        self,
        output: Path | None,
        size: int,
        choice: Choice,
        scene: QuantizedScene | GridScene | WrittenFile,
        search: SearchResult | None,
        quality: Quality | None,
    ) -> CompressResult:
        options, plan = self.options, self.plan
        fixed = options.fixed is not None
        scored = search.scored if search else None
        held_out = quality.fidelity if quality is not None and self.trained is not None else None
        warnings = doubts(self.views, scored, self.scene.input_count, self.trained, held_out) if self.views else ()
        for warning in warnings:
            LOG.warning("warning: %s", warning)
        return CompressResult(
            scene=scene_info(self.scene),
            views=views_info(self.views) if self.views else None,
            output=None if output is None else os.fspath(output),
            size=size,
            count=scene.count,
            sh_count=scene.sh_count,
            prune_rate=choice.prune / 1000,
            sh_rate=choice.sh / 1000,
            method=options.method,
            score=options.score if plan.needs_scores else None,
            select=options.select,
            bits=asdict(scene.bits) if isinstance(scene, QuantizedScene) else {},
            groups={name: a.groups for name, a in scene.arrays.items()} if isinstance(scene, QuantizedScene) else {},
            steps=scene.steps.to_json() if isinstance(scene, GridScene) else None,
            target=plan.target.describe() if plan.target else None,
            decided_by=plan.decided_by,
            reached=search.reached if search and not fixed else None,
            decision_views=plan.kind_of(plan.decide, self.views),
            search=search,
            sensitivity=tuple(self.sensitivity),
            quality=quality,
            quality_views=plan.kind_of(plan.report, self.views),
            scores_saved=options.save_scores,
            score_cache=options.score_cache if plan.computes_scores else None,
            scores_reused=self.scores_reused,
            run=run_info(self.budget, self.clock, self.workspace.backend if self.workspace else None, self.storage),
            format=self.format.suffix[1:] if self.format else "fgs",
            file_sh_degree=scene.sh_degree,
            scored=scored,
            training_fidelity=self.trained,
            warnings=warnings,
        )
