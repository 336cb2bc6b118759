"""`info --errors`: measure the quality and the bytes that each channel of a `.fgs` is worth."""

from __future__ import annotations

import os
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

from flexgs_edge.codec.open_fgs import open_fgs
from flexgs_edge.commands.info import info
from flexgs_edge.commands.reduced import reduced_scenes
from flexgs_edge.constants import DEFAULT_BASE_PSNR
from flexgs_edge.errors import InputError
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.report.worth_result import WorthChange, WorthResult
from flexgs_edge.run.judge import Judge
from flexgs_edge.run.open_bench import open_bench
from flexgs_edge.run.options import ViewOptions
from flexgs_edge.run.plan import Plan
from flexgs_edge.run.run import open_run
from flexgs_edge.run.view_set import views_info
from flexgs_edge.scene.fields import FIELDS

COPIES = 4
"""Bound on the scenes in memory, each counted as float32: codes, reduced codes, reduced values, and the coder's buffers."""


def worth(
    path: str | os.PathLike[str], options: ViewOptions | None = None, progress: Progress = SILENT, **words: Any
) -> WorthResult:
    """Reduce each channel of a `.fgs` in turn, and measure bytes saved and quality lost.

    Parameters
    ----------
    path : path
        A `.fgs` file.
    options : ViewOptions, optional
        Options as on the command line. Default: the cameras beside the file, else automatic ones. Only held-out views are
        drawn. Photos are not used: the references are renders of the file itself.
    progress : Progress, optional
        Shows a bar.
    **words
        Single options, by the names of `ViewOptions`.

    Returns
    -------
    WorthResult
        The result of `info`, the views, and a record for each change of `reduced_scenes`. A record holds the bytes saved, the
        fidelity (dB, None if no render changes) and the modelled drop (dB), both over the pixels that the file covers.
    """
    options = replace(options or ViewOptions(), images=None, **words)
    place = Path(path)
    if place.suffix.lower() != ".fgs":
        raise InputError(f"{path}: --errors needs a .fgs file: other formats have no bits to take away")
    found = info(place)
    if not found.count:
        raise InputError(f"{path}: --errors: the file holds no Gaussians, so there is nothing to draw")
    run = open_run(place, options, progress, photos=False)
    views = run.seen
    chosen = views.held_out or views.train
    stored = found.settings.get("base_psnr")
    base = stored if isinstance(stored, (int, float)) and 0.0 < stored < 200.0 else DEFAULT_BASE_PSNR
    changes = []
    with ExitStack() as stack:
        bench = stack.enter_context(open_bench(run))
        renderer = bench.renderer
        run.budget.take("the codes", COPIES * found.count * sum(4 * f.width(found.sh_degree) for f in FIELDS))
        judge = Judge(bench, run.source, views, chosen, with_photos=False, base_psnr=base)
        stack.callback(judge.close)
        with renderer.load(run.source) as original:
            judge.prepare(original, progress)
        lessers = reduced_scenes(open_fgs(place))
        for item in progress.track(lessers, "taking channels away", len(lessers)):
            saved, less = item.make()
            with renderer.load(less) as drawn:
                quality = judge.compare(drawn)
            fidelity = None if quality.covered_fidelity is None else round(quality.covered_fidelity, 4)
            drop = round(quality.covered_modelled_drop, 6)
            changes.append(WorthChange(item.channel, item.change, saved, fidelity, drop))
    kind = Plan.kind_of(chosen, views)
    return WorthResult(found, views_info(views), len(chosen), kind, base, tuple(changes))
