"""Compression into formats of other programs: every step writes a file, reads it back and measures it."""

from __future__ import annotations

import logging

from flexgs_edge.io.exchange import read_foreign
from flexgs_edge.methods.best.method import choose_poses, search_best
from flexgs_edge.methods.foreign.by_cost import file_maker
from flexgs_edge.methods.foreign.file_maker import open_files, publish
from flexgs_edge.run.judges import Judges
from flexgs_edge.run.made import Made
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.run import Run
from flexgs_edge.units import format_size
from flexgs_edge.views.bench import Bench

LOG = logging.getLogger("flexgs_edge")


def compress(run: Run[CompressOptions], bench: Bench) -> Made:
    """Compress a scene into a file of another program's format, by measured costs.

    `run`: planned. `bench`: draws the views.
    """
    options, plan, output, format = run.options, run.plan, run.output.path, run.output.format
    assert plan is not None and plan.target is not None and format is not None
    with Judges(run, bench) as judges:
        judges.prepare()
        if options.antialiased and not format.marks_antialiased:
            LOG.warning("%s does not say that the model is antialiased: viewers must be told", format.suffix)
        poses = choose_poses(run, bench, judges.decide)
        with open_files(run, format, bench, judges) as files:
            LOG.info("searching for %s", plan.target.describe())
            file, search = search_best(file_maker(options, files), run, bench, poses, judges.decide)
            judges.decided()
            quality = judges.measure(read_foreign(file.path))
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
            trained=judges.trained,
        )
