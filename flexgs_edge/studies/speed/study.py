"""`study speed`: how much accuracy speed costs in drawing, scoring and whole runs."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from flexgs_edge.errors import InputError
from flexgs_edge.files import atomic_folder, check_folder
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.report.plots import require_matplotlib
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.studies.experiment import Experiment
from flexgs_edge.studies.page import study_page
from flexgs_edge.studies.speed.drawing import drawing
from flexgs_edge.studies.speed.presets import presets
from flexgs_edge.studies.speed.scoring import scoring
from flexgs_edge.studies.study_scene import StudyScene, open_study_scene, scene_names
from flexgs_edge.studies.written import SceneStudy, WrittenStudy, write_scene

LOG = logging.getLogger("flexgs_edge")

PARTS = ("drawing", "scoring", "presets")
REPEATS = 5


class SpeedStudy(WrittenStudy):
    """The results of `study speed`, and their folder."""

    command = "study speed"


def study_speed(
    scene: str | Path,
    output: str | Path,
    options: CompressOptions | None = None,
    progress: Progress = SILENT,
    parts: Sequence[str] = PARTS,
    repeats: int = REPEATS,
    **words: Any,
) -> SpeedStudy:
    """Measure speed against accuracy on a scene and write it to a folder.

    Raises `FlexGSError`: `InputError` (also when matplotlib is missing), `DeviceError` or `BudgetError`. Nothing is
    written then.
    """
    options = replace(options or CompressOptions(), **words)
    _check(parts, repeats)
    # Matplotlib is loaded before the memory is planned, so that its bytes count as taken.
    require_matplotlib()
    check_folder(output, options.force)
    with atomic_folder(output, options.force) as folder:
        (name,) = scene_names([scene])
        with open_study_scene(scene, name, replace(options, method="paper"), progress) as studied:
            found = SceneStudy.of(studied, _on_bench(studied, parts, repeats))
        if "presets" in parts:
            # These runs need the memory of the scene above, which is free by now.
            found = replace(found, experiments=(*found.experiments, presets(scene, options, progress)))
        page = study_page("Speed and accuracy", _INTRO, [write_scene(folder, found)])
        (folder / "index.html").write_text(page, encoding="utf-8")
    LOG.info("wrote %s", Path(output) / "index.html")
    return SpeedStudy(os.fspath(output), found)


_INTRO = (
    "The cost of less work: drawing views less exactly, scoring Gaussians from fewer views, and searching less. "
    " The Pareto front joins points that no other point beats in time and accuracy. Times are wall times "
    "of this run on the device named below. Everything but times, and the fronts that they decide, is equal in every run."
)


def _check(parts: Sequence[str], repeats: int) -> None:
    unknown = [part for part in parts if part not in PARTS]
    if unknown or not parts:
        raise InputError(f"--parts {','.join(unknown or parts)}: expected one or more of {', '.join(PARTS)}")
    if repeats < 1:
        raise InputError(f"--repeats {repeats}: expected 1 or more")


def _on_bench(studied: StudyScene, parts: Sequence[str], repeats: int) -> list[Experiment]:
    makers: dict[str, Callable[[], list[Experiment]]] = {
        "drawing": lambda: [drawing(studied, repeats)],
        "scoring": lambda: scoring(studied),
    }
    made: list[Experiment] = []
    for part, make in makers.items():
        if part in parts:
            LOG.info("%s: %s", studied.name, part)
            made += make()
    return made
