"""`study stability` on a tiny scene: every experiment's rows, and what counts as broken."""

from __future__ import annotations

import csv
import io
import json
import resource
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import click
import pytest

from flexgs_edge.cli import app
from flexgs_edge.cli.study import stability as command
from flexgs_edge.commands.compress import compress
from flexgs_edge.quality.psnr import mean_psnr
from flexgs_edge.report.plots import BarChart, LineChart
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.studies.stability import BREAK, LOST, METHODS, QUICK, study_stability
from flexgs_edge.studies.written import Study
from tiny_project import make_project

pytestmark = pytest.mark.usefixtures("short_searches")

OPTIONS = CompressOptions(holdout=3, max_drop=1.0)
AMOUNTS = replace(QUICK, width=None, distances=(0.25, 1.0, 4.0))
KEYS = ["heldout", "distance", "poses"]
Written = tuple[Study, Path]


@pytest.fixture(scope="module")
def project(short_searches: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_project(tmp_path_factory.mktemp("stability") / "cloud")


@pytest.fixture(scope="module")
def study(project: Path, tmp_path_factory: pytest.TempPathFactory) -> Written:
    out = tmp_path_factory.mktemp("written") / "out"
    return study_stability(project / "point_cloud.ply", out, OPTIONS, amounts=AMOUNTS), out


def rows_of(study: Written, key: str, **where: object) -> list[dict[str, object]]:
    rows = json.loads((study[1] / f"{key}.json").read_text())["rows"]
    return [row for row in rows if all(row[name] == value for name, value in where.items())]


def number(value: object) -> float:
    assert isinstance(value, (int, float))
    return float(value)


def test_every_experiment_has_its_files(study: Written) -> None:
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


def test_what_broke_lost_three_decibels(study: Written) -> None:
    for row in (*rows_of(study, "distance"), *rows_of(study, "poses")):
        assert row["broke"] == (LOST if row["below"] is not None and number(row["below"]) > BREAK else None)


def test_the_worst_view_is_that_of_compress(study: Written, project: Path) -> None:
    rows = rows_of(study, "heldout")
    assert [row["method"] for row in rows] == list(METHODS)
    for row in rows:
        worst, allowed = number(row["worst"]), number(row["allowed"])
        assert row["within"] == (worst <= allowed + 1e-9)
        assert allowed == pytest.approx(1.5 * max(number(row["drop"]), 0) + 0.2, abs=2e-4)
    own = METHODS["best, --promise mean"]
    made = compress(
        project / "point_cloud.ply", None, replace(OPTIONS, effort="fast", best_effort=True, **own), dry_run=True
    )
    (row,) = (row for row in rows if row["method"] == "best, --promise mean")
    assert made.quality is not None and made.quality.worst is not None
    assert (row["size"], row["view"]) == (made.size, made.quality.worst.name)
    assert row["worst"] == pytest.approx(made.quality.worst.drop, abs=1e-3)
    # Two of the three poses that are held out are looked at again, in the written file: means of dB, as everywhere.
    (seen,) = rows_of(study, "poses", method="best, --promise mean", poses="held out")
    assert seen["views"] == 2
    assert seen["fidelity"] == pytest.approx(mean_psnr([view.fidelity for view in made.quality.views[:2]]), abs=2e-3)


def test_the_command_line_hands_on_what_it_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], study: Written
) -> None:
    told: dict[str, object] = {}

    def told_study(scene: str, output: str, options: CompressOptions, progress: object, **words: object) -> Study:
        told.update(words, scene=scene, max_drop=options.max_drop)
        return study[0]

    monkeypatch.setattr("flexgs_edge.studies.stability.study_stability", told_study)
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
