"""`score`: save the importance of every Gaussian, so that later runs of the method `paper` need no scoring."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge.errors import InputError
from flexgs_edge.files import check_writable
from flexgs_edge.methods.paper.scores import SCORE_ROW_BYTES, SCORES, score_cache, score_scene
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.report.file_results import ScoreResult
from flexgs_edge.run.decoding import decode_bytes, read_often
from flexgs_edge.run.foresight import drawing_bytes
from flexgs_edge.run.inputs import scene_info
from flexgs_edge.run.open_context import context_info, open_context
from flexgs_edge.run.options import ViewOptions
from flexgs_edge.run.run import open_run
from flexgs_edge.run.view_set import views_info


def score_gaussians(
    input: str | Path,  # a scene file or a model folder
    output: str | Path,
    options: ViewOptions | None = None,  # options as on the command line
    score: str = "gs",  # The score to compute. Default: `gs`.
    force: bool = False,  # Overwrite `output` if it exists. Default: raise `InputError`.
    progress: Progress = SILENT,  # shows a bar
    **words: Any,  # single options, by the names of `ViewOptions`
) -> ScoreResult:
    """Score every Gaussian over the training views, and save the scores.

    `output`: the `.npz` file to write, as `score_cache` reads it: `scores` [N] f64, logarithms of the scores, -inf for
    Gaussians that no view sees, and a fingerprint of what they depend on. Returns what was scored, times and memory.
    """
    options = replace(options or ViewOptions(), **words)
    if score not in SCORES:
        raise InputError(f"--score {score!r}: expected one of {', '.join(SCORES)}")
    if Path(output).suffix.lower() != ".npz":
        raise InputError(f"-o {output}: expected a name that ends in .npz")
    check_writable(output, force)
    # Open the photos as `compress` does: their size sets the size of the views, and with it the scores.
    run = open_run(input, options, progress)
    views, clock = run.seen, run.clock
    if not views.train:
        raise InputError(f"{views.cameras_from}: every view is held out: give more views, or --holdout 0")
    sums = SCORE_ROW_BYTES * run.source.count

    def needed() -> int:
        return sums + drawing_bytes(run) + decode_bytes(run.source, None)

    with open_context(run, needed=needed, compares=False) as context:
        renderer = context.renderer
        run.budget.take("scores", sums)
        with clock.stage("load"):
            source = read_often(run.source, run.budget, drawing_bytes(run), renderer.backend)
            device_scene = renderer.load(source)
        with device_scene, clock.stage("score"):
            scores = score_scene(renderer, device_scene, source, views.of(views.train), score, progress)
        score_cache(output, run, score).save(scores)
        return ScoreResult(
            scene=scene_info(run.scene),
            views=views_info(views),
            output=os.fspath(output),
            score=score,
            scored_views=len(views.train),
            unseen=int(np.isneginf(scores).sum()),
            run=context_info(run, context),
        )
