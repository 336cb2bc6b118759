"""Makes one HTML page of a study, with every chart, table and finding."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from flexgs_edge.report.html import render
from flexgs_edge.studies.experiment import Experiment


@dataclass(frozen=True)
class Section:
    """The part of the page about one scene: its name, facts about it, and its experiments with their charts as SVG."""

    name: str
    facts: Sequence[tuple[str, str]]
    experiments: Sequence[tuple[Experiment, bytes]]


def study_page(title: str, intro: str, sections: Sequence[Section]) -> str:
    """The page as HTML."""
    return render("study.html", title=title, intro=intro, sections=sections)
