"""`evaluate`: a scene against a reference, view by view."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

from flexgs_edge.constants import DEFAULT_BASE_PSNR
from flexgs_edge.errors import InputError
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.quality.lpips import Lpips
from flexgs_edge.report.results import EvaluateResult
from flexgs_edge.run.clock import Stopwatch
from flexgs_edge.run.companions import companions_of, merge_companions
from flexgs_edge.run.inputs import load_scene, resolve_drawing, scene_info
from flexgs_edge.run.judge import Judge
from flexgs_edge.run.open_bench import Workspace
from flexgs_edge.run.options import ViewOptions
from flexgs_edge.run.reporter import Reporter
from flexgs_edge.run.view_set import WITHOUT_VIEWS, find_views, views_info


def evaluate(
    input: str | Path,
    against: str | Path,
    options: ViewOptions | None = None,
    base_psnr: float = DEFAULT_BASE_PSNR,
    progress: Progress = SILENT,
    report: str | Path | None = None,
    force: bool = False,
    lpips: bool = False,
    **words: Any,
) -> EvaluateResult:
    """Measure what a scene lost against another one.

    Parameters
    ----------
    input : path
        The scene to judge (a file or a model folder).
    against : path
        The original. Cameras and photos beside it are used unless given; else those beside `input`.
    options : ViewOptions, optional
        What the command line would say; `holdout=0` evaluates every view, otherwise the held-out views.
    base_psnr : float
        PSNR of the original that the modelled drop starts from, dB.
    report : path, optional
        Folder for a page about the run (index.html) and its record (result.json).
    force : bool
        Overwrite the files of an earlier report.
    lpips : bool
        Measure LPIPS as well (extra `lpips`).
    **words
        Single options by the names of `ViewOptions`.
    """
    options = replace(options or ViewOptions(), **words)
    if not 0.0 < base_psnr < 200.0:
        raise InputError(f"--base-psnr {base_psnr:g}: expected decibels between 0 and 200")
    reporter = Reporter.maybe(report, force)
    clock = Stopwatch()
    budget = MemoryBudget.from_limit(options.memory_limit)
    with clock.stage("open"):
        companions = merge_companions(companions_of(against), companions_of(input))
        reference = load_scene(against, options.drop_invalid)
        scene = load_scene(input, options.drop_invalid)
        # Both are drawn alike; a compressed scene knows how its original was.
        options = resolve_drawing(options, scene if scene.settings else reference, companions)
        views = find_views(options, companions, reference.source)
        if views is None:
            raise InputError(WITHOUT_VIEWS)
        indices = views.held_out or views.train
        if reporter is not None:
            reporter.see_cameras(views, reference)
    with ExitStack() as stack:
        workspace = stack.enter_context(Workspace(options, budget, clock))
        if reporter is not None:
            reporter.reserve(budget, views, indices)
        renderer = workspace.renderer
        distance: Lpips | None = None
        if lpips:  # before any drawing: packages or weights may be missing
            with clock.stage("lpips"):
                distance = Lpips(budget, max(camera.width * camera.height for camera in views.of(indices)))
            stack.callback(distance.close)
        judge = Judge(renderer, reference.source, views, indices, budget, True, base_psnr)
        stack.callback(judge.close)
        with clock.stage("references"), renderer.load(reference.source) as original:
            judge.prepare(original, progress)
        with clock.stage("measure"), renderer.load(scene.source) as compressed:
            quality = judge.compare(compressed, with_ssim=True, progress=progress, lpips=distance)
            if reporter is not None:
                reporter.look(judge, compressed, quality, clock, progress)
        result = EvaluateResult(
            scene=scene_info(scene),
            reference=scene_info(reference),
            views=views_info(views),
            quality=quality,
            quality_views="held-out" if views.held_out else "training",
            run=workspace.run_info(),
        )
    if reporter is not None:
        reporter.read_contents(input)
        reporter.write(result)
    return result
