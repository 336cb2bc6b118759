"""`compress`: a scene to the fewest bytes that hold a target."""

from __future__ import annotations

import logging
import os
from contextlib import ExitStack
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from flexgs_edge.goals.promise import in_the_way, kept_promise
from flexgs_edge.goals.steps import SearchResult
from flexgs_edge.methods.best import method as best
from flexgs_edge.methods.best.spill import expected_bytes, prepare_memory
from flexgs_edge.methods.foreign import method as foreign
from flexgs_edge.methods.paper import method as paper
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.report.results import CompressResult
from flexgs_edge.run.check_views import check_views
from flexgs_edge.run.decoding import read_often
from flexgs_edge.run.doubts import doubts
from flexgs_edge.run.foresight import foresee
from flexgs_edge.run.inputs import ScenePlace, scene_info
from flexgs_edge.run.judge import measurement_of
from flexgs_edge.run.live import live_scenes
from flexgs_edge.run.made import Made
from flexgs_edge.run.open_bench import bench_info, open_bench
from flexgs_edge.run.open_scene import is_fgs
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.run import Run, open_compression
from flexgs_edge.run.view_set import GivenViews, views_info
from flexgs_edge.views.bench import Bench

LOG = logging.getLogger("flexgs_edge")


def compress(
    input: ScenePlace,
    output: str | os.PathLike[str] | None,
    options: CompressOptions | None = None,
    progress: Progress = SILENT,
    given: GivenViews | None = None,
    **words: Any,
) -> CompressResult:
    """Compress a scene to the fewest bytes that hold a target.

    Parameters
    ----------
    input : path or CheckedScene
        A scene file (`.ply`, `.fgs`, `.spz`, `.sog`, `.compressed.ply`), INRIA's model folder, or a scene that is open.
    output : path or None
        The `.fgs`, `.spz`, `.sog` or `.compressed.ply` to write (None, for a `.fgs`, only in a dry run).
    options : CompressOptions, optional
        What the command line would say.
    progress : Progress, optional
        Bars on long work.
    given : GivenViews, optional
        Cameras and photos from memory.
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
    if options.target_is_default:
        # The scene or the format may be out of the default target's reach. Who named no target wants a file all the same.
        options = replace(options, best_effort=True)
    run = open_compression(input, output, options, progress, given)
    with run.clock.stage("open"):
        prepare_memory(run)
        _foresee(run)
    with ExitStack() as stack:
        bench = None if run.views is None else stack.enter_context(open_bench(run, options.cluster))
        _foresee(run, opened=True)
        if bench is not None:
            run = check_views(run, bench, options.trust_views)
        ready = run if bench is None or options.method != "paper" else _read_often(run, bench)
        if options.method == "paper":
            made = paper.compress(ready, bench)
        elif run.output.format is not None:
            assert bench is not None  # the plan has refused such runs without views
            made = foreign.compress(ready, bench)
        else:
            assert bench is not None  # the plan has refused such runs without views
            made = best.compress(ready, bench)
        result = _result(run, bench, made)
    if run.reporter is not None:
        if run.output.path is not None:
            run.reporter.read_contents(run.output.path)
            _show_live(run, run.output.path)
        run.reporter.write(result, None if run.plan is None else run.plan.target)
    return result


def _foresee(run: Run[CompressOptions], opened: bool = False) -> None:
    """Let the first error about the memory limit name one that is enough; `opened` as for `foresee`."""
    if run.views is None:
        run.budget.require("the scene", 0)
    else:
        needed = paper.expected_bytes if run.options.method == "paper" else expected_bytes
        foresee(run, opened, partial(needed, run))


def _read_often(run: Run[CompressOptions], bench: Bench) -> Run[CompressOptions]:
    """The same run for the paper's search, which reads the scene for every choice that it measures."""
    with run.clock.stage("open"):
        spare = paper.searching_bytes(run)
        return run.of_source(read_often(run.source, run.budget, spare, bench.renderer.backend))


def _show_live(run: Run[CompressOptions], path: Path) -> None:
    if run.reporter is not None and run.views is not None and is_fgs(path):
        with run.clock.stage("live scenes"):
            run.reporter.show_live(lambda first: live_scenes(run, path, first))


def _result(run: Run[CompressOptions], bench: Bench | None, made: Made) -> CompressResult:
    """The record of a run; its warnings are logged."""
    options, plan, views, search = run.options, run.plan, run.views, made.search
    assert plan is not None
    scored = search.scored if search else None
    held_out = None
    if made.quality is not None and made.trained is not None:
        held_out = measurement_of(made.quality).figure("fidelity")
    warnings = doubts(views, scored, run.scene.input_count, made.trained, held_out) if views else ()
    reached = search.reached if search and options.fixed is None else None
    warnings += _default_doubts(run, reached, search)
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
        sensitivity=made.sensitivity,
        quality=made.quality,
        quality_views=plan.kind_of(plan.report, views),
        score_cache=options.score_cache if plan.needs_scores else None,
        scores_reused=made.scores_reused,
        run=bench_info(run, bench),
        format=run.output.format.suffix[1:] if run.output.format else "fgs",
        file_sh_degree=made.sh_degree,
        preview_bytes=made.preview_bytes,
        scored=scored,
        training_fidelity=made.trained,
        warnings=(*run.doubts, *warnings),
    )


def _default_doubts(run: Run[CompressOptions], reached: bool | None, search: SearchResult | None) -> tuple[str, ...]:
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
