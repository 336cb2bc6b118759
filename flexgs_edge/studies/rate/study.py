"""`study rate`: bytes against quality of every method and format."""

from __future__ import annotations

import logging
import math
import os
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from flexgs_edge.errors import InputError
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.studies.rate import trade
from flexgs_edge.studies.rate.points import best_points, paper_points, peer_points
from flexgs_edge.studies.result_tables import Experiment
from flexgs_edge.studies.study_scene import StudyScene, open_study_scene, scene_names
from flexgs_edge.studies.written import SceneStudy, WrittenStudy, write_study

LOG = logging.getLogger("flexgs_edge")

RATIOS = (8.0, 16.0, 32.0, 64.0, 128.0, 256.0)


class RateStudy(WrittenStudy):
    """The results of `study rate`, and their folder."""

    command = "study rate"


def study_rate(
    scene: str | Path,
    output: str | Path,
    options: CompressOptions | None = None,
    progress: Progress = SILENT,
    ratios: Sequence[float] = RATIOS,
    **words: Any,
) -> RateStudy:
    """Measure bytes and quality of every method on a scene and write them to a folder.

    `ratios`: PLY bytes over file bytes.

    Raises `FlexGSError`: `InputError` (also when matplotlib is missing), `DeviceError` or `BudgetError`. Nothing is
    written then.
    """
    options = replace(options or CompressOptions(), **{**words, "method": "best"})
    _check(ratios)

    def make(folder: Path) -> SceneStudy:
        (name,) = scene_names([scene])
        with open_study_scene(scene, name, options, progress) as studied:
            return SceneStudy.of(studied, _experiments(studied, folder, sorted(set(ratios))))

    found = write_study(output, options.force, "Bytes and quality", _INTRO, make)
    return RateStudy(os.fspath(output), found)


_INTRO = (
    "Bytes and quality of a scene compressed by flexgs-edge to many sizes, beside the paper's method and the formats of other "
    "programs. Sizes are bytes of the finished file. Ratios are to the PLY as INRIA writes it. All methods are judged by the "
    "same renderer over the same views."
)


def _check(ratios: Sequence[float]) -> None:
    bad = [value for value in ratios if not (math.isfinite(value) and value >= 1.0)]
    if bad:
        raise InputError(f"--ratios {bad[0]:g}: expected ratios of 1 or more, such as 8,16,32")
    if not ratios:
        raise InputError("--ratios: expected one ratio or more, such as 8,16,32")


def _experiments(studied: StudyScene, folder: Path, ratios: Sequence[float]) -> list[Experiment]:
    effort = studied.run.options.effort
    found = best_points(studied, effort, ratios) + paper_points(studied, ratios)
    with tempfile.TemporaryDirectory(prefix=".flexgs-", dir=folder) as place:
        found += peer_points(studied, Path(place))
    made = [trade.rate(studied, found.points, found.missing, effort)]
    if studied.plan.figure == "drop":
        made.append(trade.fidelity(studied, found.points, effort))
    return made
