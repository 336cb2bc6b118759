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
from flexgs_edge.errors import InputError
from flexgs_edge.progress import SILENT
from flexgs_edge.report.plots import BarChart, LineChart
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.scene.source import MemorySource
from flexgs_edge.studies.stability import heldout, removal
from flexgs_edge.studies.stability.amounts import QUICK
from flexgs_edge.studies.stability.breaks import BREAK, LOST, Outcome, curve, of_source, where_it_breaks
from flexgs_edge.studies.stability.study import StabilityStudy, study_stability
from flexgs_edge.studies.study_scene import Setting, StudyScene, open_study_scene
from tiny_project import make_project

pytestmark = pytest.mark.usefixtures("short_searches")

OPTIONS = CompressOptions(holdout=3, max_drop=1.0)
AMOUNTS = replace(
    QUICK,
    width=None,
    pruned=(300, 900),
    distances=(0.25, 1.0, 4.0),
    fewest=2,
    halves=True,
    even=True,
)
CONTENDERS = ["best", "best, --views-margin", "paper", "RTN, 8 bits", "rows only", "SH only"]
KEYS = [
    "pruning", "views", "halves", "heldout", "distance", "poses", "generations",
]  # fmt: skip
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
    for key in ("pruning", "generations"):
        for row in rows_of(study, key):
            assert row["broke"] == (LOST if number(row["loss"]) > BREAK else None)
            assert number(row["worst"]) >= number(row["loss"]) - 1e-4
    for row in (*rows_of(study, "distance"), *rows_of(study, "poses")):
        assert row["broke"] == (LOST if row["below"] is not None and number(row["below"]) > BREAK else None)


def test_removal_goes_from_mild_to_harsh(study: Study) -> None:
    for score in removal.SCORES:
        few, many = rows_of(study, "pruning", method=score)
        assert number(few["loss"]) < number(many["loss"])
    path = rows_of(study, "pruning", method=removal.BEST)
    shares = [number(row["share"]) for row in path]
    assert shares == sorted(shares) and shares[-1] >= 0.9
    random, ours = rows_of(study, "pruning", method="random")[-1], path[-1]
    assert number(ours["loss"]) < number(random["loss"])


def test_scores_from_all_views_are_their_own_reference(study: Study, studied: StudyScene) -> None:
    rows = rows_of(study, "views")
    whole = [row for row in rows if row["poses"] == "all"]
    assert [row["score"] for row in whole] == ["gs", "removal"] and {row["spearman"] for row in whole} == {1.0}
    chosen = studied.point(Setting(studied.search.chosen.choice)).measurement
    assert whole[0]["drop"] == pytest.approx(chosen.drop, abs=1e-4)
    assert {row["poses"] for row in rows} == {"all", "farthest", "first"} and min(number(r["views"]) for r in rows) == 2


def test_halves_judge_both_sides(study: Study) -> None:
    for method in ("paper, gs", "paper, removal", "best"):
        whole, half = rows_of(study, "halves", method=method)
        assert (whole["scores"], half["scores"]) == ("all", "one half")
        # What one side does not see is thrown away first: the other side pays.
        assert number(half["other"]) > number(whole["other"]) - 0.05


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


def test_generations_stay_within_the_bound(study: Study) -> None:
    for method in ("best", "paper", "RTN, 8 bits"):
        first, second = rows_of(study, "generations", method=method)
        assert number(second["size"]) <= number(first["size"])
        # best: to the bit. The others round what was rounded, to ranges that a little may be missing of.
        assert number(second["loss"]) <= number(first["loss"]) + (0.0 if method == "best" else 0.1)
    assert len(rows_of(study, "generations", method="best, two targets")) == 1


# --- the pieces


def test_where_a_method_breaks() -> None:
    rows = [
        {"x": x, "loss": y, "broke": broke}
        for x, y, broke in ((1.0, 0.2, None), (2.0, 3.5, LOST), (3.0, None, "error: no"))
    ]
    series = curve(rows, "it", "x")
    assert series.broken == [2.0] and series.y == [0.2, 3.5, None]
    said = where_it_breaks(rows, "it", lambda row: f"{row['x']:g}")
    assert said == "it stands up to 1 (0.20 dB) and breaks at 2 (3.50 dB)."
    assert where_it_breaks(rows[:1], "it", lambda row: "1") == "it stands everywhere (at worst 0.20 dB, 1)."
    assert where_it_breaks(rows[2:], "it", lambda row: "3") == "it breaks at 3 (error: no)."


def test_errors_are_rows_and_not_the_end(studied: StudyScene) -> None:
    def fails() -> tuple[int, MemorySource]:
        raise InputError("too far")

    found = of_source(studied, fails)
    assert found == Outcome(None, None, "too far") and found.cells(studied)["broke"] == "error: too far"


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
    assert left.value.code == 0 and "--quick" in text and "generations" in text
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
