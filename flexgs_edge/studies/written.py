"""The results of a study on a scene: as text, as a record for programs, and as files."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from flexgs_edge.files import atomic_folder, check_folder
from flexgs_edge.report.html import render
from flexgs_edge.report.plots import picture, require_matplotlib
from flexgs_edge.report.run_info import RunInfo, SceneInfo, ViewsInfo, fields_json, record
from flexgs_edge.report.summary import device_words
from flexgs_edge.run.inputs import scene_info
from flexgs_edge.run.open_context import context_info
from flexgs_edge.run.view_set import views_info
from flexgs_edge.studies.result_tables import Experiment, json_bytes
from flexgs_edge.studies.study_scene import StudyScene

LOG = logging.getLogger("flexgs_edge")


@dataclass(frozen=True)
class Section:
    """The part of the page about one scene: its name, facts about it, and its experiments with their charts as SVG."""

    name: str
    facts: Sequence[tuple[str, str]]
    experiments: Sequence[tuple[Experiment, bytes]]


@dataclass(frozen=True)
class SceneStudy:
    """The experiments on one scene, with facts about scene, views and device."""

    name: str
    scene: SceneInfo
    views: ViewsInfo
    decided_by: str
    experiments: tuple[Experiment, ...]
    run: RunInfo

    @classmethod
    def of(cls, studied: StudyScene, experiments: list[Experiment]) -> SceneStudy:
        """The results of `experiments` on `studied`."""
        return cls(
            studied.name,
            scene_info(studied.run.scene),
            views_info(studied.views),
            studied.decided_by,
            tuple(experiments),
            context_info(studied.run, studied.context),
        )

    def to_json(self) -> dict[str, Any]:
        """The record for machines."""
        return fields_json(self)

    def to_lines(self) -> list[str]:
        """The findings, for people."""
        lines = [f"{self.name}: {self.scene.count} Gaussians; {self.decided_by}"]
        for experiment in self.experiments:
            lines.append(f"  {experiment.title}")
            lines += [f"    {words}" for words in experiment.findings]
            lines += [f"    {b.what}: {b.here}; paper: {b.paper}" for b in experiment.beside]
        return lines


@dataclass(frozen=True)
class WrittenStudy:
    """The results of a study of one scene, and their folder."""

    output: str  # the folder
    scene: SceneStudy  # the results

    command: ClassVar[str]

    def to_json(self) -> dict[str, Any]:
        """The record for machines."""
        return record(self.command, self, "scene", **self.scene.to_json())

    def to_text(self) -> str:
        """The findings, for people."""
        return "\n".join([*self.scene.to_lines(), f"wrote {os.path.join(self.output, 'index.html')}"]) + "\n"


def write_page(folder: Path, title: str, intro: str, sections: Sequence[Section]) -> None:
    """Write the page of a study into its folder."""
    page = render("study.html", title=title, intro=intro, sections=sections)
    (folder / "index.html").write_text(page, encoding="utf-8")


def write_study(
    output: str | os.PathLike[str], force: bool, title: str, intro: str, make: Callable[[Path], SceneStudy]
) -> SceneStudy:
    """Write the results that `make` returns to a folder, which appears when all is done."""
    # Matplotlib is loaded before the memory is planned, so that its bytes count as taken.
    require_matplotlib()
    check_folder(output, force)
    with atomic_folder(output, force) as folder:
        found = make(folder)
        write_page(folder, title, intro, [write_scene(folder, found)])
    LOG.info("wrote %s", os.path.join(output, "index.html"))
    return found


def write_scene(place: Path, scene: SceneStudy) -> Section:
    """Write every experiment's rows and chart into an existing folder; returns their section of the page."""
    drawn = []
    for experiment in scene.experiments:
        png, svg = picture(experiment.chart)
        record = {"scene": scene.name, "decided_by": scene.decided_by, **experiment.to_json()}
        for suffix, data in (
            ("csv", experiment.table.to_csv()),
            ("json", json_bytes(record)),
            ("png", png),
            ("svg", svg),
        ):
            (place / f"{experiment.key}.{suffix}").write_bytes(data)
        drawn.append((experiment, svg))
    return Section(scene.name, _facts(scene), drawn)


def _facts(scene: SceneStudy) -> list[tuple[str, str]]:
    views = scene.views
    facts = [
        ("file", scene.scene.path),
        (
            "Gaussians",
            f"{scene.scene.count}, SH degree {scene.scene.sh_degree}, PLY {scene.scene.ply_bytes / 1e6:.1f} MB",
        ),
        (
            "views",
            f"{views.total} of {views.width}x{views.height}, {views.train} training and {views.held_out} held out",
        ),
        ("decided by", scene.decided_by),
    ]
    facts += [("note", note) for note in (*scene.scene.notes, *views.notes)]
    if scene.run.device is not None:
        facts.append(("device", device_words(scene.run.device)))
    return facts
