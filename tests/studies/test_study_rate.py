"""`study rate` on a tiny scene: points against the pipeline's own runs, bytes and losses read off a curve."""

from __future__ import annotations

import csv
import io
import json
import math
from dataclasses import replace
from pathlib import Path

import click
import pytest

from flexgs_edge.cli import app
from flexgs_edge.cli.study import rate as command
from flexgs_edge.cli.value_types import RATIOS
from flexgs_edge.commands.compress import compress
from flexgs_edge.commands.decompress import decompress
from flexgs_edge.commands.evaluate import evaluate
from flexgs_edge.errors import InputError
from flexgs_edge.report.plots import LineChart, Series, draw, picture
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.studies import rate
from flexgs_edge.studies.rate import Curve, study_rate
from flexgs_edge.studies.written import Study
from tiny_project import COUNT, make_project

pytestmark = pytest.mark.usefixtures("short_searches")

OPTIONS = CompressOptions(method="best", holdout=4, effort="fast")
RATIO, BEYOND = 3.0, 5.0  # the paper's bits alone reach the first


@pytest.fixture(scope="module")
def project(short_searches: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_project(tmp_path_factory.mktemp("rate") / "cloud")


@pytest.fixture(scope="module")
def study(project: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Study, Path]:
    out = tmp_path_factory.mktemp("written") / "out"
    with pytest.MonkeyPatch.context() as patch:
        # One format of another program: the others go the same way.
        patch.setattr("flexgs_edge.studies.rate.PEERS", (".spz",))
        found = study_rate(project / "point_cloud.ply", out, OPTIONS, ratios=[RATIO, BEYOND, 1000.0])
    return found, out


def rows_of(study: tuple[Study, Path], key: str) -> list[dict[str, object]]:
    return json.loads((study[1] / f"{key}.json").read_text())["rows"]


def test_points_are_those_of_compress_and_evaluate(study: tuple[Study, Path], project: Path, tmp_path: Path) -> None:
    rows = rows_of(study, "rate")
    assert [(row["method"], row["wanted_ratio"]) for row in rows] == [
        ("best", RATIO), ("best", BEYOND), ("paper", None), ("paper", BEYOND), ("spz", None),
    ]  # fmt: skip
    for row in rows[1], rows[2]:
        words = {"min_ratio": BEYOND} if row["method"] == "best" else {"prune_rate": 0.0, "sh_rate": 0.0}
        options = replace(OPTIONS, method=str(row["method"]), promise="mean", **words)
        made = compress(project / "point_cloud.ply", None, options, dry_run=True)
        assert (row["size"], row["kept"]) == (made.size, made.count)
        assert made.quality is not None
        assert row["drop"] == pytest.approx(made.quality.usual_drop, abs=1e-4)
        assert row["psnr"] == pytest.approx(made.quality.psnr, abs=1e-4)
        assert row["ssim"] == pytest.approx(made.quality.ssim_photo, abs=1e-5)
        assert row["flip"] == pytest.approx(made.quality.flip_photo, abs=1e-5)
        assert row["bits"] == pytest.approx(8 * made.size / made.count, abs=0.01)
    assert all(float(str(row["ratio"])) >= float(str(row["wanted_ratio"])) for row in rows if row["wanted_ratio"])
    decompress(project / "point_cloud.ply", tmp_path / "a.spz", cameras="none")
    found = evaluate(tmp_path / "a.spz", project / "point_cloud.ply", OPTIONS)
    assert rows[4]["kept"] == COUNT and rows[4]["size"] == (tmp_path / "a.spz").stat().st_size
    assert rows[4]["fidelity"] == pytest.approx(found.quality.fidelity, abs=1e-4)


def test_csv_page_and_charts_hold_the_same(study: tuple[Study, Path]) -> None:
    result, out = study
    keys = ["rate", "fidelity"]
    assert [experiment.key for experiment in result.scene.experiments] == keys
    wanted = {f"{key}.{suffix}" for key in keys for suffix in ("csv", "json", "png", "svg")}
    assert {path.name for path in out.iterdir()} == {"index.html", *wanted}
    for experiment in result.scene.experiments:
        lines = list(csv.DictReader(io.StringIO((out / f"{experiment.key}.csv").read_text())))
        assert len(lines) == len(rows_of(study, experiment.key)) == len(experiment.table.rows)
    chart = result.scene.experiments[0].chart
    assert isinstance(chart, LineChart)
    drawn = {series.label: [round(1e6 * x) for x in series.x] for series in chart.series}
    rows = rows_of(study, "rate")
    for method in drawn:
        assert drawn[method] == [row["size"] for row in rows if row["method"] == method]
    # A header of 2 kB is more than a thousandth of the scene.
    assert "Left out or not reached: best at 1000x; paper at 1000x." in result.summary()


def test_without_photos(project: Path, tmp_path: Path) -> None:
    found = study_rate(project / "point_cloud.ply", tmp_path / "out", replace(OPTIONS, images="none"), ratios=[RATIO])
    (experiment,) = found.scene.experiments
    assert isinstance(experiment.chart, LineChart) and "fidelity" in experiment.chart.y_label
    assert set(experiment.table.values("drop")) == {None} and None not in experiment.table.values("fidelity")
    assert set(experiment.table.values("method")) == {"best", "paper", "spz", "sog", "compressed.ply"}


def test_a_curve_reads_power_laws_and_ends_at_its_points() -> None:
    curve = Curve((size, 40 / size) for size in (400, 100, 200, 50))
    assert curve.size(0.16) == pytest.approx(250) and curve.size(0.1) == pytest.approx(400)
    assert curve.size(0.81) is None and curve.size(-0.1) is None
    # The larger of two files is the worse one: nobody would take it.
    assert Curve([(100, 1.0), (200, 2.0), (400, 0.5)]).size(1.0) == pytest.approx(100)
    assert Curve([]).size(1.0) is None


def test_a_chart_over_megabytes_has_a_log_axis_and_need_not_start_at_zero() -> None:
    series = (Series("best", [0.03, 0.5, 1.1], [38.0, 45.0, 51.0], notes=["256x", "", "8x"]),)
    chart = LineChart("t", "MB", "dB", series, log_x=True, floating=True)
    (axes,) = draw(chart).axes
    assert axes.get_xscale() == "log" and axes.get_ylim()[0] > 30
    assert {0.05, 0.1, 0.2, 0.5, 1.0} <= {round(float(tick), 6) for tick in axes.get_xticks()}
    assert picture(chart) == picture(chart)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ({"ratios": [0.5]}, "--ratios 0.5: expected ratios of 1 or more"),
        ({"ratios": []}, "--ratios: expected one ratio or more"),
        ({"ratios": [math.nan]}, "--ratios nan"),
    ],
)
def test_ratios_are_checked_before_any_work(tmp_path: Path, words: dict[str, object], said: str) -> None:
    with pytest.raises(InputError, match=said.replace("'", ".")):
        study_rate(tmp_path / "none.ply", tmp_path / "out", **words)  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []


def test_the_command_line_hands_on_what_it_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], study: tuple[Study, Path]
) -> None:
    told: dict[str, object] = {}

    def told_study(scene: str, output: str, options: CompressOptions, progress: object, **words: object) -> Study:
        told.update(words, effort=options.effort, scene=scene)
        return study[0]

    monkeypatch.setattr("flexgs_edge.studies.rate.study_rate", told_study)
    words = ["study", "rate", "a.ply", "-o", str(tmp_path / "out"), "--ratios", "10,20", "-q"]
    with pytest.raises(SystemExit) as left:
        app.main([*words, "--json", "-"])
    assert left.value.code == 0
    assert told == {"ratios": (10.0, 20.0), "effort": "balanced", "scene": "a.ply"}
    out = capsys.readouterr()
    assert json.loads(out.out)["command"] == "study rate" and "Bytes and fidelity" in out.err
    with pytest.raises(SystemExit) as left:
        app.main([*words, "--ratios", "10;20"])
    assert left.value.code == 2 and "expected ratios such as 8,16,32, or none" in capsys.readouterr().err


def test_help_teaches(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        app.main(["study", "rate", "--help"])
    text = capsys.readouterr().out
    assert left.value.code == 0 and "flexgs-edge study rate point_cloud.ply -o rate" in text
    options = [option for option in command.params if isinstance(option, click.Option)]
    assert all(option.help and option.help.endswith(".") for option in options)
    # Written twice: the library is not loaded to show the help.
    defaults = {option.name: option.default for option in options}
    assert RATIOS.convert(defaults["ratios"], None, None) == rate.RATIOS
