"""`compress`: a scene to the fewest bytes that hold a target."""

import os
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge.cameras.auto import CloseUp
from flexgs_edge.codec.open_fgs import file_version
from flexgs_edge.codec.v2.container import write_grid
from flexgs_edge.goals.promise import in_the_way, kept_promise
from flexgs_edge.goals.steps import Scored, SearchResult
from flexgs_edge.grid.step_sizes import StepSizes, position_grid
from flexgs_edge.grid.to_grid import to_grid
from flexgs_edge.io.exchange import write_offset
from flexgs_edge.methods.best import method as best
from flexgs_edge.methods.foreign import method as foreign
from flexgs_edge.methods.paper import method as paper
from flexgs_edge.progress import LOG, SILENT, Progress
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.report.pages import Live
from flexgs_edge.report.results import CompressResult
from flexgs_edge.run.check_views import check_views
from flexgs_edge.run.clean import cleaned, write_removed
from flexgs_edge.run.inputs import Options, ScenePlace, scene_info
from flexgs_edge.run.method_result import MethodResult
from flexgs_edge.run.open_renderer import drawn_info, open_renderer
from flexgs_edge.run.open_scene import is_fgs
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.quality_evaluator import measurement_of
from flexgs_edge.run.run import Run, open_compression
from flexgs_edge.run.view_set import GivenViews, ViewSet, views_info
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import SceneSource
from flexgs_edge.units import format_size
from flexgs_edge.viewer.assets import LIVE, web_files
from flexgs_edge.viewer.join import join_modules
from flexgs_edge.viewer.scene_page import page_config

SCENE_MOST = 8_000_000  # Most bytes of a scene in a report; it takes a third more there
ROWS_MOST = 400_000  # Most Gaussians of an original: more do not fit into that
FIT_GAP = 2.0  # We warn of overfitting when training views show this much more fidelity than held-out views, dB
NEEDED_VIEWS = 16  # We warn below this many scored views; more change little
UNSEEN_SHARE = 0.01  # We warn when automatic views miss more than this share of the Gaussians
NAMED = 4  # So many places are named in a warning
ROW_BYTES = 59 * 4 * 4  # Memory that coding takes for a Gaussian: its values, their forms and codes


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
            run = cleaned(run, renderer)
        made = method.compress(run, renderer)
        result = _result(run, renderer, made)
        write_removed(run)
    if run.output.path is not None and run.output.format is not None and run.output.offset is not None:
        LOG.info(write_offset(run.output.path, run.output.offset, run.output.format, options.force))
    if run.reporter is not None:
        if run.output.path is not None:
            run.reporter.read_contents(run.output.path)
            if run.views is not None and is_fgs(run.output.path):
                with run.clock.stage("live scenes"):
                    run.reporter.show_live(partial(live_scenes, run, run.output.path))
        run.reporter.write(result, None if run.plan is None else run.plan.target)
    return result


def _result(run: Run[CompressOptions], renderer: Renderer | None, made: MethodResult) -> CompressResult:
    """The record of a run; its warnings are logged."""
    options, plan, views, search = run.options, run.plan, run.views, made.search
    assert plan is not None
    scored = search.scored if search else None
    held_out = None
    if made.quality is not None and made.trained is not None:
        held_out = measurement_of(made.quality).figure("fidelity")
    warnings = view_warnings(views, scored, run.scene.input_count, made.trained, held_out, made.lost) if views else ()
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
        removed=run.removed,
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


def live_scenes(run: Run[Options], path: str | os.PathLike[str], first: int) -> Live:
    """What the live scenes of a report need."""
    look = {"near": run.options.near, "background": run.options.background, "antialiased": run.options.antialiased}
    config = {**page_config("", run.seen.cameras, look), "first": first}
    size = os.stat(path).st_size
    if size > SCENE_MOST:
        return Live("", config, None, None, f"The file, {format_size(size)}, is too large for this page")
    original, note = _original(run)
    return Live(join_modules(web_files(file_version(path)), LIVE), config, Path(path).read_bytes(), original, note)


def _original(run: Run[Options]) -> tuple[bytes | None, str]:
    """The original as a `.fgs`, or why it is not there."""
    source = run.source
    large = "The original is too large for this page"
    if source.count > ROWS_MOST:
        return None, large
    if run.budget.free < source.count * ROW_BYTES:
        return None, "The memory limit leaves no room for coding the original for this page"
    with tempfile.TemporaryDirectory(prefix="flexgs-live-") as folder:
        place = Path(folder) / "original.fgs"
        if _write_fine(source, place) > SCENE_MOST:
            return None, large
        return place.read_bytes(), ""


def _write_fine(source: SceneSource, place: Path) -> int:
    """Code a scene so finely that its pictures are those of the scene; returns the bytes."""
    planes = source.read(slice(0, source.count), list(FIELD))
    degrees = np.full(source.count, source.sh_degree, np.uint8)
    steps = fine_steps(planes["means"], planes["log_scales"], source.sh_degree)
    grid, _ = to_grid(planes, degrees, steps, source.origin)
    return write_grid(place, grid, {})


def fine_steps(means: np.ndarray, log_scales: np.ndarray, sh_degree: int) -> StepSizes:
    """Step sizes whose errors nobody sees; of positions, a sixteenth of the size of a small Gaussian.

    `means`, `log_scales`: [3, n] f32.
    """
    small = float(np.exp(np.percentile(log_scales.max(axis=0), 10)))
    position, contraction = position_grid(means, max(small / 16, 2.0**-70))
    return StepSizes(position, 0.025, 0.005, 0.05, 0.01, (0.015,) * sh_degree, contraction=contraction)


def view_warnings(
    views: ViewSet,
    scored: Scored | None,
    count: int,
    trained: float | None,
    held_out: float | None,
    lost: Sequence[CloseUp] = (),
) -> tuple[str, ...]:
    """Warnings of a run, as sentences for a person.

    `views`: all views of the run. `scored`: numbers of scored views and of unseen Gaussians; `None` if the search
    measured no costs. `count`: Gaussians of the scene. `trained`, `held_out`: mean fidelity on training views and on
    held-out views, dB; `None` if not measured. `lost`: what automatic views show small, and looks wrong from near by.
    """
    found = []
    if trained is not None and held_out is not None and trained - held_out > FIT_GAP:
        found.append(
            f"Fidelity is {trained:.1f} dB on training views and {held_out:.1f} dB on held-out views, {trained - held_out:.1f} "
            "dB less. The result fits the views that were scored, and others may look worse. Give more cameras, and "
            "leave made ones in (--views-margin)."
        )
    if scored is not None and scored.poses < NEEDED_VIEWS:
        found.append(
            f"Only {scored.poses} camera views were used; below about {NEEDED_VIEWS} the result may look worse from elsewhere. "
            "Give more cameras, and leave made ones in (--views-margin)."
        )
    if scored is not None and views.automatic and scored.unseen > UNSEEN_SHARE * count:
        found.append(
            f"{scored.unseen} of {count} Gaussians ({100 * scored.unseen / count:.1f} %) appear in none of the {scored.poses} "
            "automatic views that were scored, so nothing checked how they look. Give the scene's cameras (--cameras PATH), or "
            "choose with --unseen what happens to them."
        )
    if lost:
        named = [f"({', '.join(f'{value:.3g}' for value in each.place)})" for each in lost[:NAMED]]
        more = f" and {len(lost) - NAMED} more places" if len(lost) > NAMED else ""
        found.append(
            f"About {sum(each.count for each in lost)} Gaussians around {', '.join(named)}{more} are shown by no view from near "
            "by, and look wrong from there. Give cameras that walk up to them (--cameras PATH)."
        )
    return tuple(found)
