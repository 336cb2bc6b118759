"""`compress`: a scene to the fewest bytes that hold a target."""

from __future__ import annotations

import os
from contextlib import ExitStack
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from flexgs_edge.goals.promise import in_the_way, kept_promise
from flexgs_edge.goals.steps import SearchResult
from flexgs_edge.io.exchange import write_offset
from flexgs_edge.methods.best import method as best
from flexgs_edge.methods.foreign import method as foreign
from flexgs_edge.methods.paper import method as paper
from flexgs_edge.progress import LOG, SILENT, Progress
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.report.results import CompressResult
from flexgs_edge.run.check_views import check_views
from flexgs_edge.run.inputs import ScenePlace, scene_info
from flexgs_edge.run.live import live_scenes
from flexgs_edge.run.method_result import MethodResult
from flexgs_edge.run.open_renderer import drawn_info, open_renderer
from flexgs_edge.run.open_scene import is_fgs
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.quality_evaluator import measurement_of
from flexgs_edge.run.run import Run, open_compression
from flexgs_edge.run.view_set import GivenViews, views_info
from flexgs_edge.run.warnings import view_warnings


def compress(
    input: ScenePlace,
    output: str | os.PathLike[str] | None,
    options: CompressOptions | None = None,  # what the command line would say
    progress: Progress = SILENT,  # bars on long work
    given: GivenViews | None = None,  # cameras and photos from memory
    **words: Any,  # single options by the names of `CompressOptions`, such as `max_drop=0.5`
) -> CompressResult:
    """Compress a scene to the fewest bytes that hold a target.

    `input`: a scene file (`.ply`, `.fgs`, `.spz`, `.sog`, `.compressed.ply`), INRIA's model folder, or a scene that is
    open. `output`: the `.fgs`, `.spz`, `.sog` or `.compressed.ply` to write (None, for a `.fgs`, only in a dry run).
    Returns sizes, quality of the decoded file, every step of the search, times. Raises `FlexGSError`: `InputError`,
    `TargetError`, `DeviceError` or `BudgetError`; nothing is left behind then.
    """
    options = replace(options or CompressOptions(), **words)
    run = open_compression(input, output, options, progress, given)
    method = paper if options.method == "paper" else best if run.output.format is None else foreign
    with ExitStack() as stack:
        renderer = None
        if run.views is None:
            run.budget.require("the scene", 0)
        else:
            needed = partial(method.expected_bytes, run)
            renderer = stack.enter_context(open_renderer(run, needed))
            run = check_views(run, renderer, options.trust_views)
        made = method.compress(run, renderer)
        result = _result(run, renderer, made)
    if run.output.path is not None and run.output.format is not None and run.output.offset is not None:
        LOG.info(write_offset(run.output.path, run.output.offset, run.output.format, options.force))
    if run.reporter is not None:
        if run.output.path is not None:
            run.reporter.read_contents(run.output.path)
            _show_live(run, run.output.path)
        run.reporter.write(result, None if run.plan is None else run.plan.target)
    return result


def _show_live(run: Run[CompressOptions], path: Path) -> None:
    if run.reporter is not None and run.views is not None and is_fgs(path):
        with run.clock.stage("live scenes"):
            run.reporter.show_live(lambda first: live_scenes(run, path, first))


def _result(run: Run[CompressOptions], renderer: Renderer | None, made: MethodResult) -> CompressResult:
    """The record of a run; its warnings are logged."""
    options, plan, views, search = run.options, run.plan, run.views, made.search
    assert plan is not None
    scored = search.scored if search else None
    held_out = None
    if made.quality is not None and made.trained is not None:
        held_out = measurement_of(made.quality).figure("fidelity")
    warnings = view_warnings(views, scored, run.scene.input_count, made.trained, held_out) if views else ()
    reached = search.reached if search and options.fixed is None else None
    warnings += _default_warnings(run, reached, search)
    had = scene_info(run.scene).bytes
    if had is not None and made.size > had and not options.dry_run:
        warnings += (
            f"The result has {made.size} bytes, the input {had}: keep the input, or ask for less (--max-size, --max-drop, "
            "--min-fidelity).",
        )
    promise = kept_promise(plan.target, made.size, search.chosen.measurement) if search else None
    for warning in warnings:
        LOG.warning("warning: %s", warning)
    return CompressResult(
        scene=scene_info(run.scene),
        views=views_info(views) if views else None,
        output=None if run.output.path is None else os.fspath(run.output.path),
        size=made.size,
        count=made.count,
        sh_count=made.sh_count,
        prune_rate=made.choice.prune / 1000,
        sh_rate=made.choice.sh / 1000,
        method=options.method,
        score=options.score if plan.needs_scores else None,
        select=options.select,
        bits=asdict(made.bits) if made.bits is not None else {},
        groups=dict(made.groups or {}),
        steps=made.step_sizes.to_json() if made.step_sizes is not None else None,
        target=plan.target.describe() if plan.target else None,
        decided_by=plan.decided_by,
        reached=reached,
        decision_views=plan.kind_of(plan.decide, views),
        search=search,
        promise=promise,
        quality=made.quality,
        quality_views=plan.kind_of(plan.report, views),
        score_cache=options.score_cache if plan.needs_scores else None,
        scores_reused=made.scores_reused,
        run=drawn_info(run, renderer),
        format=run.output.format.suffix[1:] if run.output.format else "fgs",
        file_sh_degree=made.sh_degree,
        preview_bytes=made.preview_bytes,
        scored=scored,
        training_fidelity=made.trained,
        warnings=(*run.warnings, *warnings),
    )


def _default_warnings(run: Run[CompressOptions], reached: bool | None, search: SearchResult | None) -> tuple[str, ...]:
    """Warn if the default target was missed, or if a size leaves no room for the promise."""
    format, plan = run.output.format, run.plan
    if plan is None or plan.target is None or search is None:
        return ()
    chosen = search.chosen
    obstacle = in_the_way(plan.target, chosen.size, chosen.measurement)
    if plan.target.limit_bytes is not None:
        return (f"the size leaves no room for the whole promise: {obstacle}",) if obstacle else ()
    if reached is not False or not run.options.target_is_default:
        return ()
    if obstacle:
        return (f"the default target is out of reach. Of the promise, {obstacle}. The closest result was written.",)
    missed = f"{plan.target.describe()} (the default) is out of reach"
    if format is not None:
        missed += f" of {format.suffix}, which rounds too coarsely for this scene"
    finer = "" if format is None else " A .fgs rounds as finely as the target asks."
    return (f"{missed}. The closest result was written.{finer}",)
