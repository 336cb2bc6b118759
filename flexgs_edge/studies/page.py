"""One page for a whole study: every chart, table and finding, in one file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from flexgs_edge.report.html import render
from flexgs_edge.studies.experiment import Experiment


@dataclass(frozen=True)
class Section:
    """A scene of the page: its name, lines about it, and its experiments with their charts as SVG."""

    name: str
    facts: Sequence[tuple[str, str]]
    experiments: Sequence[tuple[Experiment, bytes]]


def study_page(title: str, intro: str, sections: Sequence[Section]) -> str:
    """The page as HTML."""
    return render("study.html", title=title, intro=intro, sections=sections)
