"""The results of a study on a scene: tables, text, a record for programs, and files."""

import csv
import io
import os
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flexgs_edge.files import atomic_folder, check_folder
from flexgs_edge.goals.target import Measurement
from flexgs_edge.progress import LOG
from flexgs_edge.report.as_json import json_text, rounded
from flexgs_edge.report.html import count, render
from flexgs_edge.report.plots import Chart, picture, require_matplotlib
from flexgs_edge.report.results import CompressResult, decided_words
from flexgs_edge.report.run_info import Result, RunInfo, SceneInfo, ViewsInfo, fields_json, record
from flexgs_edge.report.summary import device_words

Cell = str | int | float | bool | None
Row = Mapping[str, Cell]

FIGURES = {
    "size": "bytes",
    "ratio": "ratio to PLY",
    "drop": "drop (dB)",
    "fidelity": "fidelity (dB)",
    "modelled_drop": "modelled drop (dB)",
}  # Columns of every measured file, and their heads


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
class Table:
    """The measurements of an experiment. Every row holds exactly the columns, in their order.

    Numbers are rounded when rows are made, so that CSV, JSON, page and charts show the same ones.
    """

    columns: Mapping[str, str]  # heads on the page, with units, by the keys in rows, CSV and JSON
    rows: tuple[Row, ...]

    def __post_init__(self) -> None:
        for number, row in enumerate(self.rows):
            if list(row) != list(self.columns):
                raise ValueError(
                    f"row {number}: expected the columns {', '.join(self.columns)}, found {', '.join(row)}"
                )

    def values(self, column: str, **where: Cell) -> list[Any]:
        """Cells of `column` in the rows whose other cells equal those in `where`."""
        return [row[column] for row in self.rows if all(row[key] == cell for key, cell in where.items())]

    def to_csv(self) -> bytes:
        """CSV in UTF-8 with a head line and LF. None is an empty cell, and floats read back exactly."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self.columns)
        writer.writerows(map(_csv_cell, row.values()) for row in self.rows)
        return text.getvalue().encode()

    def words(self) -> list[list[str]]:
        """The rows' cells as people read them."""
        return [[_words(cell) for cell in row.values()] for row in self.rows]


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
            "columns": dict(self.table.columns),
            "rows": [dict(row) for row in self.table.rows],
            "findings": list(self.findings),
        }


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
    def of(cls, path: str | Path, found: CompressResult, *experiments: Experiment) -> "SceneStudy":
        """Experiments on the scene of a run of `compress`."""
        assert found.views is not None
        return cls(scene_name(path), found.scene, found.views, decided_words(found), experiments, found.run)

    def to_json(self) -> dict[str, Any]:
        """The record for machines."""
        return fields_json(self)

    def to_lines(self) -> list[str]:
        """The findings, for people."""
        lines = [f"{self.name}: {self.scene.count} Gaussians; {self.decided_by}"]
        for experiment in self.experiments:
            lines += [f"  {experiment.title}", *(f"    {words}" for words in experiment.findings)]
        return lines


@dataclass(frozen=True)
class Study(Result):
    """The results of a study of one scene, and their folder."""

    command: str
    output: str  # the folder
    scene: SceneStudy  # the results

    def to_json(self) -> dict[str, Any]:
        return record(self.command, self, "command", "scene", **self.scene.to_json())

    def summary(self) -> str:
        return "\n".join([*self.scene.to_lines(), f"wrote {os.path.join(self.output, 'index.html')}"]) + "\n"


def write_study(
    command: str,
    output: str | os.PathLike[str],
    force: bool,
    title: str,
    intro: str,
    make: Callable[[Path], SceneStudy],  # takes a folder for files that do not stay
) -> Study:
    """Write the results that `make` returns to a folder, which appears when all is done.

    Raises `InputError` when matplotlib is missing or the folder is in use, and what `make` raises. Nothing is written then.
    """
    # Matplotlib is loaded before the memory is planned, so that its bytes count as taken.
    require_matplotlib()
    check_folder(output, force)
    with atomic_folder(output, force) as folder:
        with tempfile.TemporaryDirectory(prefix=".flexgs-", dir=folder) as place:
            found = make(Path(place))
        _write(folder, title, intro, found)
    LOG.info("wrote %s", os.path.join(output, "index.html"))
    return Study(command, os.fspath(output), found)


def _write(folder: Path, title: str, intro: str, scene: SceneStudy) -> None:
    """Write the page, and every experiment's rows and chart."""
    drawn = []
    for experiment in scene.experiments:
        png, svg = picture(experiment.chart)
        rows = {"scene": scene.name, "decided_by": scene.decided_by, **experiment.to_json()}
        files = {"csv": experiment.table.to_csv(), "json": json_text(rows).encode(), "png": png, "svg": svg}
        for suffix, data in files.items():
            (folder / f"{experiment.key}.{suffix}").write_bytes(data)
        drawn.append((experiment, svg))
    page = render("study.html", title=title, intro=intro, name=scene.name, facts=_facts(scene), experiments=drawn)
    (folder / "index.html").write_text(page, encoding="utf-8")


def _facts(scene: SceneStudy) -> list[tuple[str, str]]:
    about, views = scene.scene, scene.views
    facts = [
        ("file", about.path),
        ("Gaussians", f"{about.count}, SH degree {about.sh_degree}, PLY {about.ply_bytes / 1e6:.1f} MB"),
        (
            "views",
            f"{views.total} of {views.width}x{views.height}, {views.train} training and {views.held_out} held out",
        ),
        ("decided by", scene.decided_by),
    ]
    facts += [("note", note) for note in (*about.notes, *views.notes)]
    if scene.run.device is not None:
        facts.append(("device", device_words(scene.run.device)))
    return facts


def scene_name(path: str | Path) -> str:
    """A short name of a scene: the file's name, or its folder's if the file is a `point_cloud`.

    >>> [scene_name(path) for path in ("b/fox/point_cloud/iteration_7000/point_cloud.ply", "garden.fgs")]
    ['fox', 'garden']
    """
    place = Path(path).absolute()
    parts = [part for part in place.parts[1:-1] if part != "point_cloud" and not part.startswith("iteration_")]
    stem = place.name if place.is_dir() else place.name.split(".")[0]
    return parts[-1] if stem in ("point_cloud", "") and parts else stem
