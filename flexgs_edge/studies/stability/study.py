"""`study stability`: under which conditions methods break, experiment by experiment."""

from __future__ import annotations

import logging
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from flexgs_edge.files import atomic_folder, check_folder
from flexgs_edge.methods.best.rounds import PruneRounds
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.report.plots import require_matplotlib
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.studies.experiment import Experiment
from flexgs_edge.studies.page import study_page
from flexgs_edge.studies.stability import removal
from flexgs_edge.studies.stability.amounts import FULL, QUICK, Amounts
from flexgs_edge.studies.stability.contenders import Contenders
from flexgs_edge.studies.stability.generations import generations
from flexgs_edge.studies.stability.heldout import held_out
from flexgs_edge.studies.stability.ours import Whole, search, walked
from flexgs_edge.studies.stability.unseen_poses import poses
from flexgs_edge.studies.study_scene import StudyScene, open_study_scene, scene_names
from flexgs_edge.studies.written import SceneStudy, WrittenStudy, write_scene

LOG = logging.getLogger("flexgs_edge")

EFFORT = "fast"
"""Effort of all searches. The study makes many, and breaks show at every effort."""


COPIES = 4
"""Copies of the scene's planes that compressing it again holds at once."""


@dataclass(frozen=True)
class StabilityStudy(WrittenStudy):
    """The results of `study stability`, and their folder."""

    quick: bool

    command = "study stability"

    def to_json(self) -> dict[str, Any]:
        """The record for programs."""
        return {**super().to_json(), "quick": self.quick}


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
    # Matplotlib is loaded before the memory is planned, so that its bytes count as taken.
    require_matplotlib()
    check_folder(output, options.force)
    with atomic_folder(output, options.force) as folder:
        (name,) = scene_names([scene])
        with open_study_scene(scene, name, options, progress, scores=("gs", "meson")) as studied:
            found = SceneStudy.of(studied, _experiments(studied, amounts, folder))
        page = study_page("Stability", _INTRO, [write_scene(folder, found)])
        (folder / "index.html").write_text(page, encoding="utf-8")
    LOG.info("wrote %s", Path(output) / "index.html")
    return StabilityStudy(os.fspath(output), found, quick)


_INTRO = (
    "Where methods break. A method has broken at a point if it loses more than 3 dB there, or ends in an error. "
    "Charts cross out the first such point of each method, and the dashed line is the limit. All files are judged "
    "by the same renderer. Means over few views hide single bad ones, so the worst view, and where it matters the "
    "worst tile, are shown beside them."
)


def _experiments(studied: StudyScene, amounts: Amounts, folder: Path) -> list[Experiment]:
    source, train = studied.run.source, studied.views.of(studied.views.train)
    studied.run.budget.require(
        "copies of the scene", COPIES * source.count * sum(4 * source.width(name) for name in FIELD)
    )
    temporary = tempfile.TemporaryDirectory(prefix=".flexgs-", dir=folder)
    with temporary as place:
        # These rounds come first: two at once would take twice the memory.
        with walked(studied, source, train, margin=True) as path:
            guarded = search(studied, path, studied.target)
        with walked(studied, source, train) as path:
            return _along_the_path(studied, path, guarded, amounts, Path(place))


def _along_the_path(
    studied: StudyScene, path: PruneRounds, guarded: Whole, amounts: Amounts, place: Path
) -> list[Experiment]:
    made: list[Experiment] = []

    @contextmanager
    def part(name: str) -> Iterator[None]:
        LOG.info("%s: %s", studied.name, name)
        with studied.run.clock.stage(name):
            yield

    with part("results at the target"):
        ours = search(studied, path, studied.target)
        contenders = Contenders(studied, ours, guarded)
    with part("views"):
        made.append(removal.views(studied, amounts))
        if amounts.halves and (sides := removal.halves(studied, ours)) is not None:
            made.append(sides)
    with part("held-out views"):
        made.append(held_out(studied, path, contenders, amounts))
    with part("poses"):
        made += poses(studied, contenders, amounts)
    with part("generations"):
        made.append(generations(studied, path, ours, amounts, place))
    # This comes last, because it prunes until nothing is left.
    with part("pruning"):
        made.insert(0, removal.pruning(studied, path, amounts))
    return made
