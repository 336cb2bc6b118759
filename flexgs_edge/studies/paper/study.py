"""`study paper`: repeats the evaluation of the FlexGaussian paper on any scene."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from flexgs_edge.errors import InputError
from flexgs_edge.files import atomic_folder, check_folder
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.report.plots import require_matplotlib
from flexgs_edge.report.run_info import record
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.studies.paper import pruning, quantization, whole
from flexgs_edge.studies.result_tables import Experiment
from flexgs_edge.studies.study_scene import StudyScene, open_study_scene, scene_names
from flexgs_edge.studies.written import SceneStudy, write_page, write_scene

LOG = logging.getLogger("flexgs_edge")

Maker = Callable[[StudyScene], Experiment]  # Makes an experiment on a scene
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


@dataclass(frozen=True)
class PaperStudy:
    """The results of `study paper`, and their folder."""

    output: str
    scenes: tuple[SceneStudy, ...]

    def to_json(self) -> dict[str, Any]:
        """The record for programs."""
        return record("study paper", self)

    def to_text(self) -> str:
        """The findings, for people."""
        lines = [line for scene in self.scenes for line in scene.to_lines()]
        return "\n".join([*lines, f"wrote {os.path.join(self.output, 'index.html')}"]) + "\n"


def study_paper(
    scenes: Sequence[str | Path],
    output: str | Path,
    options: CompressOptions | None = None,
    progress: Progress = SILENT,
    experiments: Sequence[Maker] | None = None,
    **words: Any,
) -> PaperStudy:
    """Make the paper's experiments on every scene and write them to a folder.

    Raises `FlexGSError`: `InputError` (also when matplotlib is missing), `DeviceError` or `BudgetError`. Nothing is
    written then.
    """
    options = replace(options or CompressOptions(), **{**words, "method": "paper"})
    experiments = EXPERIMENTS if experiments is None else experiments
    if not scenes:
        raise InputError("no scene: give one or more .ply, .fgs or model folders")
    # Matplotlib is loaded before the memory is planned, so that its bytes count as taken.
    require_matplotlib()
    check_folder(output, options.force)
    with atomic_folder(output, options.force) as folder:
        names = scene_names(scenes)
        found = [_study_scene(path, name, options, progress, experiments) for path, name in zip(scenes, names)]
        _write(folder, found)
    LOG.info("wrote %s", Path(output) / "index.html")
    return PaperStudy(os.fspath(output), tuple(found))


def _study_scene(
    path: str | Path, name: str, options: CompressOptions, progress: Progress, makers: Sequence[Maker]
) -> SceneStudy:
    with open_study_scene(path, name, options, progress, scores=("gs", "meson")) as studied:
        # The search runs first: experiments build on its answer, and its steps must be measured, not remembered.
        LOG.info("%s: searching for %s", name, studied.target.describe())
        chosen = studied.search.chosen
        LOG.info("%s: prune %g, SH %g", name, chosen.choice.prune / 1000, chosen.choice.sh / 1000)
        experiments = []
        for number, make in enumerate(makers, 1):
            started = time.perf_counter()
            LOG.info("%s: experiment %d of %d, %s", name, number, len(makers), make.__name__)
            experiments.append(make(studied))
            LOG.info("%s: %s: %.1f s", name, experiments[-1].key, time.perf_counter() - started)
        return SceneStudy.of(studied, experiments)


def _write(folder: Path, scenes: Sequence[SceneStudy]) -> None:
    sections = []
    for scene in scenes:
        place = folder / scene.name
        place.mkdir()
        sections.append(write_scene(place, scene))
    intro = (
        "The experiments of the FlexGaussian paper (Tian et al., ACM MM 2025), repeated by flexgs-edge with its own programs, "
        "containers and quality figures. Sizes are bytes of the finished file. Ratios are to the PLY as INRIA writes it. The "
        "paper's figures are means over its own scenes, so beside one scene they only give the order of magnitude."
    )
    write_page(folder, "The paper's evaluation", intro, sections)
