"""What every experiment gives back: a table, a chart of the same numbers, and what they say."""

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
    """One experiment on one scene.

    Parameters
    ----------
    key : str
        Name of its files.
    title : str
        For people.
    question : str
        What was done, and what the columns mean where their heads do not say it.
    table : Table
        What was measured.
    chart : Chart
        Drawn from the table's rows.
    findings : tuple of str
        What the numbers say: sentences made from the table.
    beside : tuple of Beside
        The paper's own figures, where it gives some.
    timed : bool
        The table holds times, so it differs from run to run.
    """

    key: str
    title: str
    question: str
    table: Table
    chart: Chart
    findings: tuple[str, ...]
    beside: tuple[Beside, ...] = ()
    timed: bool = False

    def to_json(self) -> dict[str, Any]:
        """The record for machines."""
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
