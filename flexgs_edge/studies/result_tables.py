"""Tables of experiments, which are written as CSV, JSON and HTML."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from flexgs_edge.goals.target import Measurement
from flexgs_edge.report.as_json import rounded
from flexgs_edge.report.html import count
from flexgs_edge.report.plots import Chart

Cell = str | int | float | bool | None
Row = Mapping[str, Cell]

FIGURES = {
    "size": "bytes",
    "ratio": "ratio to PLY",
    "drop": "drop (dB)",
    "fidelity": "fidelity (dB)",
    "modelled_drop": "modelled drop (dB)",
}
"""Columns of every measured file, and their heads."""


def figures(size: int, ply_bytes: int, found: Measurement) -> dict[str, Cell]:
    """Cells of the columns `FIGURES`: bytes, and quality in the figures that decide."""
    return {
        "size": size,
        "ratio": round(ply_bytes / size, 3),
        "drop": rounded(found.drop),
        "fidelity": rounded(found.figure("fidelity")),
        "modelled_drop": rounded(found.figure("modelled drop")),
    }


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

    def words(self) -> list[list[str]]:
        """The rows' cells as people read them."""
        return [[_words(cell) for cell in row.values()] for row in self.rows]


def columns(**heads: str) -> tuple[Column, ...]:
    """Columns from `name="head"`."""
    return tuple(Column(name, head) for name, head in heads.items())


def number(row: Row, column: str) -> float:
    """The number in a cell."""
    value = row[column]
    assert isinstance(value, (int, float)), f"{column}: {value!r}"
    return float(value)


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
class Experiment:
    """One experiment on one scene."""

    key: str  # name of its files, without suffix
    title: str  # title on the page
    question: str  # what was done, and what columns mean if their heads do not say it
    table: Table  # the measurements
    chart: Chart  # a chart of the table's rows
    findings: tuple[str, ...]  # sentences made from the table's numbers
    timed: bool = False  # whether the table holds times, so that it differs from run to run

    def to_json(self) -> dict[str, Any]:
        """The record for programs."""
        return {
            "experiment": self.key,
            "title": self.title,
            "question": self.question,
            "timed": self.timed,
            "columns": {column.name: column.head for column in self.table.columns},
            "rows": [dict(row) for row in self.table.rows],
            "findings": list(self.findings),
        }
