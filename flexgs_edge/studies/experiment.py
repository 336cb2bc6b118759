"""The result of an experiment: a table, a chart of the same numbers, and sentences about them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from flexgs_edge.report.plots import Chart
from flexgs_edge.studies.result_tables import Table


@dataclass(frozen=True)
class Beside:
    """A figure measured here beside the published one."""

    what: str
    here: str
    paper: str


@dataclass(frozen=True)
class Experiment:
    """One experiment on one scene."""

    key: str  # name of its files, without suffix
    title: str  # title on the page
    question: str  # what was done, and what columns mean if their heads do not say it
    table: Table  # the measurements
    chart: Chart  # a chart of the table's rows
    findings: tuple[str, ...]  # sentences made from the table's numbers
    beside: tuple[Beside, ...] = ()  # figures of the FlexGaussian paper, if it gives some
    timed: bool = False  # whether the table holds times, so that it differs from run to run

    def to_json(self) -> dict[str, Any]:
        """The record for programs."""
        return {
            "experiment": self.key,
            "title": self.title,
            "question": self.question,
            "timed": self.timed,
            "columns": {column.name: column.head for column in self.table.columns},
            "rows": self.table.to_json(),
            "findings": list(self.findings),
            "beside_the_paper": [{"what": b.what, "here": b.here, "paper": b.paper} for b in self.beside],
        }
