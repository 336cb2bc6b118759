"""`study stability` on a tiny scene: every experiment's rows, and what counts as broken."""

from __future__ import annotations

import csv
import io
import json
import resource
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import click
import pytest

from flexgs_edge.cli import app
from flexgs_edge.cli.study.stability import command
from flexgs_edge.progress import SILENT
from flexgs_edge.report.plots import BarChart, LineChart
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.studies.stability import heldout
from flexgs_edge.studies.stability.ours import BREAK, LOST
from flexgs_edge.studies.stability.study import StabilityStudy, study_stability
from flexgs_edge.studies.stability.unseen_poses import QUICK
from flexgs_edge.studies.study_scene import StudyScene, open_study_scene
from tiny_project import make_project

pytestmark = pytest.mark.usefixtures("short_searches")

OPTIONS = CompressOptions(holdout=3, max_drop=1.0)
AMOUNTS = replace(QUICK, width=None, distances=(0.25, 1.0, 4.0), even=True)
CONTENDERS = ["best", "best, --views-margin", "paper", "RTN, 8 bits", "rows only", "SH only"]
KEYS = ["heldout", "distance", "poses"]
Study = tuple[StabilityStudy, Path]


@pytest.fixture(scope="module")
def project(short_searches: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_project(tmp_path_factory.mktemp("stability") / "cloud")


@pytest.fixture(scope="module")
def studied(project: Path) -> Iterator[StudyScene]:
    options = replace(OPTIONS, method="best", effort="fast")
    with open_study_scene(project / "point_cloud.ply", "cloud", options, SILENT) as opened:
        yield opened


@pytest.fixture(scope="module")
def study(project: Path, tmp_path_factory: pytest.TempPathFactory) -> Study:
    out = tmp_path_factory.mktemp("written") / "out"
    return study_stability(project / "point_cloud.ply", out, OPTIONS, amounts=AMOUNTS), out


def rows_of(study: Study, key: str, **where: object) -> list[dict[str, object]]:
    rows = json.loads((study[1] / f"{key}.json").read_text())["rows"]
    return [row for row in rows if all(row[name] == value for name, value in where.items())]


def number(value: object) -> float:
    assert isinstance(value, (int, float))
    return float(value)


def test_every_experiment_has_its_files(study: Study) -> None:
    result, out = study
    assert [experiment.key for experiment in result.scene.experiments] == KEYS
    wanted = {f"{key}.{suffix}" for key in KEYS for suffix in ("csv", "json", "png", "svg")}
    assert {path.name for path in out.iterdir()} == {"index.html", *wanted}
    page = (out / "index.html").read_text()
    for experiment in result.scene.experiments:
        assert experiment.title in page and experiment.findings
        assert isinstance(experiment.chart, (LineChart, BarChart)) and experiment.chart.limit is not None
        lines = list(csv.DictReader(io.StringIO((out / f"{experiment.key}.csv").read_text())))
        assert len(lines) == len(rows_of(study, experiment.key)) == len(experiment.table.rows)


def test_what_broke_lost_three_decibels(study: Study) -> None:
    for row in (*rows_of(study, "distance"), *rows_of(study, "poses")):
        assert row["broke"] == (LOST if row["below"] is not None and number(row["below"]) > BREAK else None)


def test_the_worst_view_and_the_views_that_did_not_decide(study: Study, studied: StudyScene) -> None:
    rows = rows_of(study, "heldout")
    assert [row["method"] for row in rows] == [*CONTENDERS, heldout.EVEN, heldout.HELD]
    assert number(rows[-1]["worst"]) <= 1.5 and number(rows[-1]["loss"]) <= 1.0
    names = [camera.name for camera in studied.judge.cameras]
    for row in rows:
        loss, worst = number(row["loss"]), number(row["worst"])
        assert row["within"] == (worst <= number(row["allowed"]) + 1e-9) and row["view"] in names
        assert number(row["allowed"]) == pytest.approx(1.5 * max(loss, 0) + 0.2, abs=2e-4)
        assert number(row["tile"]) < number(row["fidelity"])
        count, even = len(names), len(names[::2])
        assert loss == pytest.approx(
            (even * number(row["even"]) + (count - even) * number(row["odd"])) / count, abs=2e-4
        )
    assert number(rows[-2]["even"]) <= 1.0


def test_the_command_line_hands_on_what_it_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], study: Study
) -> None:
    told: dict[str, object] = {}

    def told_study(
        scene: str, output: str, options: CompressOptions, progress: object, **words: object
    ) -> StabilityStudy:
        told.update(words, scene=scene, max_drop=options.max_drop)
        return study[0]

    monkeypatch.setattr("flexgs_edge.studies.stability.study.study_stability", told_study)
    words = [
        "study",
        "stability",
        "a.ply",
        "-o",
        str(tmp_path / "out"),
        "--quick",
        "--max-drop",
        "0.5",
        "-q",
        "--json",
        "-",
    ]
    with pytest.raises(SystemExit) as left:
        app.main(words)
    assert left.value.code == 0 and told == {"quick": True, "scene": "a.ply", "max_drop": 0.5}
    out = capsys.readouterr()
    assert json.loads(out.out)["command"] == "study stability" and "The worst view" in out.err


def test_help_teaches(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        app.main(["study", "stability", "--help"])
    text = capsys.readouterr().out
    assert left.value.code == 0 and "--quick" in text
    options = [option for option in command.params if isinstance(option, click.Option)]
    assert all(option.help and option.help.endswith(".") for option in options)


@pytest.mark.timeout(900)  # a minute of processor time
def test_quick_on_the_sample_takes_no_longer_than_it_says(sample_dir: Path, tmp_path: Path) -> None:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    out = tmp_path / "quick"
    words = ["study", "stability", str(sample_dir / "point_cloud.ply"), "-o", str(out), "--quick", "-q"]
    done = subprocess.run([sys.executable, "-m", "flexgs_edge", *words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    # Processor time of both cores: what other programs take of the machine counts for nothing.
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 2 * 90
