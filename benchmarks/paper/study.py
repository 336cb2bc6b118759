"""Makes the paper's experiments on a scene, and writes their tables, charts and page."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from benchmarks.paper import pruning, quantization, whole
from benchmarks.paper.scene import StudyScene, open_study_scene
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.run.inputs import scene_info
from flexgs_edge.run.open_renderer import drawn_info
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.view_set import views_info
from flexgs_edge.studies.written import Experiment, SceneStudy, Study, scene_name, write_study

LOG = logging.getLogger("flexgs_edge")

Maker = Callable[[StudyScene], Experiment]
EXPERIMENTS: tuple[Maker, ...] = (
    quantization.rtn,
    quantization.attributes,
    pruning.splits,
    pruning.plane,
    whole.parts,
    quantization.groups,
    pruning.scores,
    whole.rates,
    whole.times,
)
INTRO = (
    "The experiments of the FlexGaussian paper (Tian et al., ACM MM 2025), repeated by flexgs-edge with its own programs, "
    "containers and quality figures. Sizes are bytes of the finished file. Ratios are to the PLY as INRIA writes it. The "
    "paper's figures are means over its own scenes, so beside one scene they only give the order of magnitude."
)


def study_paper(
    scene: str | Path,
    output: str | Path,
    options: CompressOptions,
    progress: Progress = SILENT,
    experiments: Sequence[Maker] = EXPERIMENTS,
) -> Study:
    """Make the experiments on a scene and write them to a folder."""
    options = replace(options, method="paper")
    return write_study(
        "study paper",
        output,
        options.force,
        "The paper's evaluation",
        INTRO,
        lambda folder: _study(scene, options, progress, experiments),
    )


def _study(path: str | Path, options: CompressOptions, progress: Progress, makers: Sequence[Maker]) -> SceneStudy:
    name = scene_name(path)
    with open_study_scene(path, name, options, progress, scores=("gs", "meson")) as studied:
        # The search runs first: experiments build on its answer, and its steps must be measured, not remembered.
        chosen = studied.search.chosen
        LOG.info("%s: prune %g, SH %g", name, chosen.choice.prune / 1000, chosen.choice.sh / 1000)
        experiments = []
        for number, make in enumerate(makers, 1):
            started = time.perf_counter()
            LOG.info("%s: experiment %d of %d, %s", name, number, len(makers), make.__name__)
            experiments.append(make(studied))
            LOG.info("%s: %s: %.1f s", name, experiments[-1].key, time.perf_counter() - started)
        return SceneStudy(
            name,
            scene_info(studied.run.scene),
            views_info(studied.views),
            studied.decided_by,
            tuple(experiments),
            drawn_info(studied.run, studied.renderer),
        )
