"""`study speed` on a tiny scene: runs of compress, and their front."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import click
import pytest

from flexgs_edge.cli import app
from flexgs_edge.cli.study import speed as command
from flexgs_edge.commands.compress import compress
from flexgs_edge.report.plots import LineChart, Series, draw
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.studies.speed import front, study_speed
from flexgs_edge.studies.written import Study
from tiny_project import make_project

OPTIONS = CompressOptions(method="best", holdout=4, effort="fast", max_drop=4.0)
KEYS = ["presets"]


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_project(tmp_path_factory.mktemp("speed") / "cloud", degree=2)


@pytest.fixture(scope="module")
def study(project: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Study, Path]]:
    out = tmp_path_factory.mktemp("written") / "out"
    with pytest.MonkeyPatch.context() as patch:
        # best is tested by its own tests, and takes seconds here, nearly all of them the coder's tables.
        patch.setattr("flexgs_edge.studies.speed.PRESETS", (("paper", "fast"), ("paper", "balanced")))
        yield study_speed(project / "point_cloud.ply", out, OPTIONS), out


def rows_of(study: tuple[Study, Path], key: str) -> list[dict[str, object]]:
    return json.loads((study[1] / f"{key}.json").read_text())["rows"]


def test_every_part_has_its_files(study: tuple[Study, Path]) -> None:
    result, out = study
    assert [experiment.key for experiment in result.scene.experiments] == KEYS
    wanted = {f"{key}.{suffix}" for key in KEYS for suffix in ("csv", "json", "png", "svg")}
    assert {path.name for path in out.iterdir()} == {"index.html", *wanted}
    page = (out / "index.html").read_text()
    for experiment in result.scene.experiments:
        assert experiment.title in page and experiment.findings
        lines = list(csv.DictReader(io.StringIO((out / f"{experiment.key}.csv").read_text())))
        assert len(lines) == len(rows_of(study, experiment.key))


def test_presets_are_runs_of_compress(study: tuple[Study, Path], project: Path) -> None:
    row, other = rows_of(study, "presets")
    assert (other["method"], other["effort"]) == ("paper", "balanced") and float(str(other["seconds"])) > 0
    made = compress(project / "point_cloud.ply", None, replace(OPTIONS, method="paper"), dry_run=True, best_effort=True)
    assert (row["method"], row["size"], row["kept"]) == ("paper", made.size, made.count)
    assert made.quality is not None and row["drop"] == pytest.approx(made.quality.drop, abs=1e-4)


def test_fronts() -> None:
    assert front([3, 1, 2, 2], [9, 1, 5, 4]) == [True, True, True, False] and front([], []) == []
    assert front([1, 2], [float("inf"), float("inf")]) == [True, False]


def test_a_chart_shows_its_front() -> None:
    series = (Series("ways", [1.0, 10.0, 5.0], [20.0, 40.0, None], line=False),)
    chart = LineChart("t", "ms", "dB", series, floating=True, log_x=True, front=[(10.0, 40.0), (1.0, 20.0)])
    (axes,) = draw(chart).axes
    assert axes.get_xscale() == "log"
    lines = {line.get_label(): line.get_xydata().tolist() for line in axes.lines}
    assert lines["ways"] == [[1.0, 20.0], [10.0, 40.0]] and lines["Pareto front"][0] == [1.0, 20.0]


def test_the_command_line_hands_on_what_it_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], study: tuple[Study, Path]
) -> None:
    told: dict[str, object] = {}

    def told_study(scene: str, output: str, options: CompressOptions, progress: object, **words: object) -> Study:
        told.update(words, max_drop=options.max_drop, scene=scene)
        return study[0]

    monkeypatch.setattr("flexgs_edge.studies.speed.study_speed", told_study)
    words = ["study", "speed", "a.ply", "-o", str(tmp_path / "out"), "-q"]
    with pytest.raises(SystemExit) as left:
        app.main([*words, "--json", "-"])
    assert left.value.code == 0
    assert told == {"max_drop": 1.0, "scene": "a.ply"}
    assert json.loads(capsys.readouterr().out)["command"] == "study speed"


def test_help_teaches(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        app.main(["study", "speed", "--help"])
    assert left.value.code == 0 and "flexgs-edge study speed point_cloud.ply -o speed" in capsys.readouterr().out
    options = [option for option in command.params if isinstance(option, click.Option)]
    assert all(option.help and option.help.endswith(".") for option in options)
