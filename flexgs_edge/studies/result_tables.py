"""Tables of experiments, which are written as CSV, JSON and HTML."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from flexgs_edge.report.html import count
from flexgs_edge.report.plots import Chart

Cell = str | int | float | bool | None
Row = Mapping[str, Cell]


@dataclass(frozen=True)
class Column:
    """A column of a table."""

    name: str  # key in the rows, in CSV and in JSON
    head: str  # head on the page, with the unit


@dataclass(frozen=True)
class Table:
    """The measurements of an experiment. Every row holds exactly the columns, in their order.

    Numbers are rounded when rows are made, so that CSV, JSON, page and charts show the same ones.
    """

    columns: tuple[Column, ...]
    rows: tuple[Row, ...]

    def __post_init__(self) -> None:
        names = [column.name for column in self.columns]
        for number, row in enumerate(self.rows):
            if list(row) != names:
                raise ValueError(f"row {number}: expected the columns {', '.join(names)}, found {', '.join(row)}")

    def values(self, column: str, **where: Cell) -> list[Any]:
        """Cells of `column` in the rows whose other cells equal those in `where`."""
        return [row[column] for row in self.rows if all(row[key] == cell for key, cell in where.items())]

    def to_csv(self) -> bytes:
        """CSV in UTF-8 with a head line and LF. None is an empty cell, and floats read back exactly."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(column.name for column in self.columns)
        writer.writerows(map(_csv_cell, row.values()) for row in self.rows)
        return text.getvalue().encode()

    def to_json(self) -> list[dict[str, Cell]]:
        """The rows as dicts."""
        return [dict(row) for row in self.rows]

    def words(self) -> list[list[str]]:
        """The rows' cells as people read them."""
        return [[_words(cell) for cell in row.values()] for row in self.rows]


def json_bytes(record: Any) -> bytes:
    """A record as JSON text; raises `ValueError` for NaN and infinity."""
    return (json.dumps(record, indent=2, allow_nan=False) + "\n").encode()


def columns(**heads: str) -> tuple[Column, ...]:
    """Columns from `name="head"`."""
    return tuple(Column(name, head) for name, head in heads.items())


def mean(values: Sequence[float]) -> float:
    """Mean of at least one number."""
    return sum(values) / len(values)


def _csv_cell(cell: Cell) -> str:
    if cell is None:
        return ""
    if isinstance(cell, bool):
        return "true" if cell else "false"
    return repr(cell) if isinstance(cell, float) else str(cell)


def _words(cell: Cell) -> str:
    if cell is None:
        return "-"
    if isinstance(cell, bool):
        return "yes" if cell else "no"
    if isinstance(cell, float):
        return f"{cell:.7g}"
    return count(cell) if isinstance(cell, int) else cell


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
