"""`evaluate`: compare a scene with its original, view by view."""

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

from flexgs_edge.errors import InputError
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.quality.lpips import Lpips
from flexgs_edge.report.results import EvaluateResult
from flexgs_edge.run.check_views import check_views
from flexgs_edge.run.decoding import decode_bytes, read_often
from flexgs_edge.run.inputs import scene_info
from flexgs_edge.run.open_renderer import drawing_bytes, drawn_info, open_renderer
from flexgs_edge.run.options import ViewOptions
from flexgs_edge.run.quality_evaluator import QualityEvaluator
from flexgs_edge.run.reporter import Reporter
from flexgs_edge.run.run import open_run
from flexgs_edge.run.view_set import views_info


def evaluate(
    input: str | Path,  # the scene to measure: a file or a model folder
    against: str | Path,
    options: ViewOptions | None = None,
    base_psnr: float | None = None,  # assumed PSNR of the original against its photos, for the modelled drop, dB
    progress: Progress = SILENT,  # shows a bar
    report: str | Path | None = None,
    force: bool = False,  # overwrite an earlier report
    lpips: bool = False,  # also measure LPIPS, which takes far longer (extra `lpips`)
    **words: Any,  # single options, by the names of `ViewOptions`
) -> EvaluateResult:
    """Measure the quality that a scene lost against its original.

    `against`: the original. Its cameras and photos are used if it has some beside it, else those beside `input`. `options`:
    options as on the command line. Default: measure the held-out views; `holdout=0` measures all. `report`: write a page about
    the run (index.html) and its record (result.json) to this folder. Returns quality of every view, times and memory.
    """
    options = replace(options or ViewOptions(), **words)
    if base_psnr is not None and not 0.0 < base_psnr < 200.0:
        raise InputError(f"--base-psnr {base_psnr:g}: expected decibels between 0 and 200")
    reporter = Reporter.maybe(report, force)
    # Draw both scenes alike: a compressed scene stores how its original is drawn.
    run = open_run(against, options, progress, reporter, judged_path=input)
    views, scene, clock, budget = run.seen, run.judged or run.scene, run.clock, run.budget
    indices = views.held_out or views.train

    def needed() -> int:
        return drawing_bytes(run) + decode_bytes(run.source, None) + decode_bytes(scene.source, None)

    with ExitStack() as stack:
        renderer = stack.enter_context(open_renderer(run, needed=needed))
        run = check_views(run, renderer, trusted=True)
        distance: Lpips | None = None
        if lpips:  # first, because packages or weights may be missing
            with clock.stage("lpips"):
                distance = Lpips(budget, max(camera.width * camera.height for camera in views.of(indices)))
            stack.callback(distance.close)
        with clock.stage("load"):
            spare = drawing_bytes(run) + decode_bytes(scene.source, None)
            original_source = read_often(run.source, budget, spare, renderer.backend)
        finetuned = _finetuned(scene.settings)
        judge = QualityEvaluator(renderer, original_source, views, indices, base_psnr=base_psnr, finetuned=finetuned)
        stack.callback(judge.close)
        with clock.stage("references"), renderer.load(original_source) as original:
            judge.prepare(original, progress)
        with clock.stage("load"):
            drawn = replace(scene, source=read_often(scene.source, budget, drawing_bytes(run), renderer.backend)).drawn
        with clock.stage("measure"), renderer.load(drawn) as compressed:
            quality = judge.compare(compressed, with_ssim=True, progress=progress, lpips=distance, flip=True)
            if reporter is not None:
                reporter.look(judge, compressed, quality, clock, progress)
        result = EvaluateResult(
            scene=scene_info(scene),
            reference=scene_info(run.scene),
            views=views_info(views),
            quality=quality,
            quality_views="held-out" if views.held_out else "training",
            run=drawn_info(run, renderer),
            warnings=run.warnings,
        )
    if reporter is not None:
        reporter.read_contents(input)
        reporter.write(result)
    return result


def _finetuned(settings: dict[str, Any]) -> bool:
    """Whether the scene with these settings was fine-tuned, as far as they say."""
    distil = settings.get("distil")
    return settings.get("method", "best") == "best" and (
        settings.get("effort") != "fast" if distil is None else distil != 0
    )
