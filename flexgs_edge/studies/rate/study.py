"""`study rate`: bytes against quality of every method and format, and of `best` without each of its parts."""

from __future__ import annotations

import logging
import math
import os
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from flexgs_edge.errors import BudgetError, InputError
from flexgs_edge.files import atomic_folder, check_folder
from flexgs_edge.methods.best.effort import EFFORTS, distil_steps
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.report.plots import require_matplotlib
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.studies.experiment import Experiment
from flexgs_edge.studies.page import study_page
from flexgs_edge.studies.rate import trade
from flexgs_edge.studies.rate.ablations import WHOLE, parts_of
from flexgs_edge.studies.rate.points import MAX, Found, best_points, paper_points, peer_points
from flexgs_edge.studies.study_scene import StudyScene, open_study_scene, scene_names
from flexgs_edge.studies.written import SceneStudy, WrittenStudy, write_scene

LOG = logging.getLogger("flexgs_edge")

RATIOS = (8.0, 16.0, 32.0, 64.0, 128.0, 256.0)
ABLATED = (16.0, 64.0)
ABLATION_EFFORT = "fast"
DISTILLED = (32.0, 64.0, 128.0)
"""Ratios of the points at the effort `max`. Below 30 every pixel is looked at, and each point takes longer."""


class RateStudy(WrittenStudy):
    """The results of `study rate`, and their folder."""

    command = "study rate"


def study_rate(
    scene: str | Path,
    output: str | Path,
    options: CompressOptions | None = None,
    progress: Progress = SILENT,
    ratios: Sequence[float] = RATIOS,
    ablations: Sequence[float] = ABLATED,
    ablation_effort: str = ABLATION_EFFORT,
    distilled: Sequence[float] = DISTILLED,
    **words: Any,
) -> RateStudy:
    """Measure bytes and quality of every method on a scene and write them to a folder.

    `ratios`: PLY bytes over file bytes, for the curves; `ablations`: PLY bytes over file bytes, for the points without a
    part; `distilled`: PLY bytes over file bytes, for the points at the effort `max`.

    Raises `FlexGSError`: `InputError` (also when matplotlib is missing), `DeviceError` or `BudgetError`. Nothing is
    written then.
    """
    options = replace(options or CompressOptions(), **{**words, "method": "best"})
    _check(ratios, ablations, ablation_effort, distilled)
    # Matplotlib is loaded before the memory is planned, so that its bytes count as taken.
    require_matplotlib()
    check_folder(output, options.force)
    with atomic_folder(output, options.force) as folder:
        (name,) = scene_names([scene])
        with open_study_scene(scene, name, options, progress) as studied:
            every, without = sorted({*ratios, *ablations}), sorted(set(ablations))
            made = _experiments(studied, folder, every, without, ablation_effort, sorted(set(distilled)))
            found = SceneStudy.of(studied, made)
        page = study_page("Bytes and quality", _INTRO, [write_scene(folder, found)])
        (folder / "index.html").write_text(page, encoding="utf-8")
    LOG.info("wrote %s", Path(output) / "index.html")
    return RateStudy(os.fspath(output), found)


_INTRO = (
    "Bytes and quality of a scene compressed by flexgs-edge to many sizes, beside the paper's method and the formats of other "
    "programs. Sizes are bytes of the finished file. Ratios are to the PLY as INRIA writes it. All methods are judged by the "
    "same renderer over the same views."
)


def _check(ratios: Sequence[float], ablations: Sequence[float], effort: str, distilled: Sequence[float]) -> None:
    for word, values in (("--ratios", ratios), ("--ablations", ablations), ("--distilled", distilled)):
        bad = [value for value in values if not (math.isfinite(value) and value >= 1.0)]
        if bad:
            raise InputError(f"{word} {bad[0]:g}: expected ratios of 1 or more, such as 8,16,32")
    if not ratios:
        raise InputError("--ratios: expected one ratio or more, such as 8,16,32")
    if effort not in EFFORTS:
        raise InputError(f"--ablation-effort {effort!r}: expected one of {', '.join(EFFORTS)}")


def _experiments(
    studied: StudyScene,
    folder: Path,
    ratios: Sequence[float],
    ablations: Sequence[float],
    ablation_effort: str,
    distilled: Sequence[float],
) -> list[Experiment]:
    effort = studied.run.options.effort
    found = best_points(studied, WHOLE, effort, ratios) + paper_points(studied, ratios)
    if distilled:
        try:
            found += best_points(studied, WHOLE, MAX, distilled)
        except BudgetError as error:  # a study keeps its scenes in memory
            found += Found((), (f"best ({MAX}: {error})",))
    with tempfile.TemporaryDirectory(prefix=".flexgs-", dir=folder) as place:
        found += peer_points(studied, Path(place))
    source, options = studied.run.source, replace(studied.run.options, effort=ablation_effort)
    descends = distil_steps(options, 1, source.count) > 0
    variants = parts_of(studied.orders["gs"], source.sh_degree, descends) if ablations else ()
    if ablations and ablation_effort != effort:
        found += best_points(studied, WHOLE, ablation_effort, ratios)
    for variant in variants:
        found += best_points(studied, variant, ablation_effort, ablations)
    made = [trade.rate(studied, found.points, found.missing, effort)]
    if studied.plan.figure == "drop":
        made.append(trade.fidelity(studied, found.points, effort))
    if ablations:
        made.append(trade.parts(studied, found.points, variants, ablation_effort, ablations))
    return made
