"""`study stability`: under which conditions methods break, experiment by experiment."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.studies.result_tables import Experiment
from flexgs_edge.studies.stability.heldout import held_out
from flexgs_edge.studies.stability.ours import Contenders, search, walked
from flexgs_edge.studies.stability.unseen_poses import FULL, QUICK, Amounts, poses
from flexgs_edge.studies.study_scene import StudyScene, open_study_scene, scene_names
from flexgs_edge.studies.written import SceneStudy, WrittenStudy, write_study

EFFORT = "fast"  # Effort of all searches. The study makes many, and breaks show at every effort.
COPIES = 4  # Copies of the scene's planes that compressing it again holds at once


@dataclass(frozen=True)
class StabilityStudy(WrittenStudy):
    """The results of `study stability`, and their folder."""

    quick: bool

    command = "study stability"


def study_stability(
    scene: str | Path,
    output: str | Path,
    options: CompressOptions | None = None,
    progress: Progress = SILENT,
    quick: bool = False,
    amounts: Amounts | None = None,
    **words: Any,
) -> StabilityStudy:
    """Find the conditions under which methods break on a scene, and write them to a folder.

    Raises `FlexGSError`: `InputError` (also when matplotlib is missing), `DeviceError` or `BudgetError`. Nothing is
    written then.
    """
    options = replace(options or CompressOptions(), **{**words, "method": "best", "effort": EFFORT})
    amounts = amounts or (QUICK if quick else FULL)
    if amounts.width is not None:
        options = replace(options, resolution=min(options.resolution, amounts.width))

    def make(folder: Path) -> SceneStudy:
        (name,) = scene_names([scene])
        with open_study_scene(scene, name, options, progress) as studied:
            return SceneStudy.of(studied, _experiments(studied, amounts))

    found = write_study(output, options.force, "Stability", _INTRO, make)
    return StabilityStudy(os.fspath(output), found, quick)


_INTRO = (
    "Where methods break. A method has broken at a point if it loses more than 3 dB there, or ends in an error. "
    "Charts cross out the first such point of each method, and the dashed line is the limit. All files are judged "
    "by the same renderer. Means over few views hide single bad ones, so the worst view, and where it matters the "
    "worst tile, are shown beside them."
)


def _experiments(studied: StudyScene, amounts: Amounts) -> list[Experiment]:
    source, train = studied.run.source, studied.views.of(studied.views.train)
    studied.run.budget.require(
        "copies of the scene", COPIES * source.count * sum(4 * source.width(name) for name in FIELD)
    )
    with studied.run.clock.stage("results at the target"):
        # These rounds come first: two at once would take twice the memory.
        with walked(studied, source, train, margin=True) as path:
            guarded = search(studied, path, studied.target)
        with walked(studied, source, train) as path:
            contenders = Contenders(studied, search(studied, path, studied.target), guarded)
            made = [held_out(studied, path, contenders, amounts)]
    with studied.run.clock.stage("poses"):
        return made + poses(studied, contenders, amounts)
