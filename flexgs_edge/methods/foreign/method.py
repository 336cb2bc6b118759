"""Compression into formats of other programs: every step writes a file, reads it back and measures it."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import nullcontext

import numpy as np

from flexgs_edge.goals.steps import Step, step_words
from flexgs_edge.goals.target import Target
from flexgs_edge.io.exchange import read_foreign
from flexgs_edge.methods.best.method import choose_poses, search_best
from flexgs_edge.methods.foreign.by_cost import file_search
from flexgs_edge.methods.foreign.by_rank import search_pruned_files
from flexgs_edge.methods.foreign.file_maker import open_files, publish
from flexgs_edge.methods.paper.method import rank
from flexgs_edge.run.judges import Judges
from flexgs_edge.run.made import Made
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.run import Run
from flexgs_edge.units import format_size
from flexgs_edge.views.bench import Bench

LOG = logging.getLogger("flexgs_edge")


def compress(run: Run[CompressOptions], bench: Bench | None, scores: np.ndarray | None = None) -> Made:
    """Compress a scene into a file of another program's format.

    Parameters
    ----------
    run : Run
        Planned. Its method decides: `best` searches by measured costs, `paper` prunes in rank order.
    bench : Bench or None
        Draws the views; `None` for runs without views, whose rates are fixed.
    scores : np.ndarray or None
        [N] f64 from a file, for `paper`.
    """
    options, plan, output, format = run.options, run.plan, run.output.path, run.output.format
    assert plan is not None and format is not None
    with nullcontext() if bench is None else Judges(run, bench) as judges:
        order: np.ndarray | None = None
        reused = False
        if options.method == "paper":
            ranking = rank(run, judges, bench, scores)
            order, reused = ranking.order, ranking.reused
        elif judges is not None:
            judges.prepare()
        if options.antialiased and not format.marks_antialiased:
            LOG.warning("%s does not say that the model is antialiased: viewers must be told", format.suffix)
        poses = None
        if order is None and bench is not None and judges is not None:
            poses = choose_poses(run, bench, judges.decide)
        with open_files(run, format, bench, judges) as files:
            if plan.target is not None:
                LOG.info("searching for %s", plan.target.describe())
            if order is not None:
                with run.clock.stage("search"):
                    file, search = search_pruned_files(
                        files, run.source, order, plan.target, options, _said(plan.target)
                    )
            else:
                assert bench is not None and judges is not None and poses is not None
                file, search = search_best(file_search(options, files), run, bench, poses, judges.decide)
            if judges is not None:
                judges.decided()
            quality = None if judges is None else judges.measure(read_foreign(file.path))
            if output is not None:
                publish(file, output, options.force)
                LOG.info("wrote %s, %s", output, format_size(file.size))
        return Made(
            size=file.size,
            count=file.count,
            sh_count=file.sh_count,
            sh_degree=file.sh_degree,
            choice=search.chosen.choice,
            search=search,
            quality=quality,
            trained=None if judges is None else judges.trained,
            scores_reused=reused,
        )


def _said(target: Target | None) -> Callable[[Step], None]:
    """A function that logs each step of a search."""
    return lambda step: LOG.info("%s", step_words(step, target))
