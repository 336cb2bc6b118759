"""`study speed` on a tiny scene: what is drawn less exactly, scored from fewer views, run whole; and its front."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import click
import numpy as np
import pytest

from flexgs_edge.cameras.order import covering_order, farthest_order
from flexgs_edge.cli import app
from flexgs_edge.cli.study.speed import PARTS, command
from flexgs_edge.commands.compress import compress
from flexgs_edge.errors import InputError
from flexgs_edge.progress import SILENT
from flexgs_edge.quality.psnr import mean_psnr, mse, psnr
from flexgs_edge.report.plots import LineChart, Series, draw
from flexgs_edge.run.open_scene import open_scene
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource
from flexgs_edge.studies.speed import drawing
from flexgs_edge.studies.speed import study as speed
from flexgs_edge.studies.speed.drawing import HalfPrecision, LowerDegree
from flexgs_edge.studies.speed.front import front
from flexgs_edge.studies.speed.scoring import spearman
from flexgs_edge.studies.speed.study import SpeedStudy, study_speed
from flexgs_edge.studies.study_scene import StudyScene, open_study_scene
from synthetic import look_from, make_camera, random_scene
from tiny_project import COUNT, make_project

OPTIONS = CompressOptions(method="best", holdout=4, effort="fast", max_drop=4.0)
KEYS = ["drawing", "scoring", "stability", "presets"]


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_project(tmp_path_factory.mktemp("speed") / "cloud", degree=2)


@pytest.fixture(scope="module")
def study(project: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[SpeedStudy, Path]]:
    out = tmp_path_factory.mktemp("written") / "out"
    with pytest.MonkeyPatch.context() as patch:
        # best is tested by its own tests, and takes seconds here, nearly all of them the coder's tables.
        patch.setattr("flexgs_edge.studies.speed.presets.PRESETS", (("paper", "fast"), ("paper", "balanced")))
        yield study_speed(project / "point_cloud.ply", out, OPTIONS, repeats=1), out


@pytest.fixture(scope="module")
def studied(project: Path) -> Iterator[StudyScene]:
    with open_study_scene(project / "point_cloud.ply", "cloud", replace(OPTIONS, method="paper"), SILENT) as opened:
        yield opened


def rows_of(study: tuple[SpeedStudy, Path], key: str) -> list[dict[str, object]]:
    return json.loads((study[1] / f"{key}.json").read_text())["rows"]


def test_every_part_has_its_files(study: tuple[SpeedStudy, Path]) -> None:
    result, out = study
    assert [experiment.key for experiment in result.scene.experiments] == KEYS
    wanted = {f"{key}.{suffix}" for key in KEYS for suffix in ("csv", "json", "png", "svg")}
    assert {path.name for path in out.iterdir()} == {"index.html", *wanted}
    page = (out / "index.html").read_text()
    for experiment in result.scene.experiments:
        assert experiment.title in page and experiment.findings
        lines = list(csv.DictReader(io.StringIO((out / f"{experiment.key}.csv").read_text())))
        assert len(lines) == len(rows_of(study, experiment.key))


def test_less_exact_views_are_worse_and_dead_splats_never_show(study: tuple[SpeedStudy, Path], project: Path) -> None:
    rows = {(row["kind"], row["setting"]): row for row in rows_of(study, "drawing")}
    assert rows["exact", "exact"]["psnr"] is None and rows["exact", "exact"]["share"] == 1.0
    assert rows["opacity from", "1/255"]["psnr"] is None
    figures = {key: float(str(row["psnr"])) for key, row in rows.items() if row["psnr"] is not None}
    assert figures["SH degree", "0"] < figures["SH degree", "1"] and ("SH degree", "2") not in rows
    assert figures["resolution", "1/4"] < figures["resolution", "1/2"]
    counts = [rows["opacity from", f"{level}/255"]["gaussians"] for level in drawing.THRESHOLDS]
    logits = open_scene(project / "point_cloud.ply").read(slice(0, COUNT), ["opacity_logits"])["opacity_logits"][0]
    opacity = 1 / (1 + np.exp(-logits.astype(float)))
    assert counts == [np.count_nonzero(opacity >= level / 255) for level in drawing.THRESHOLDS]
    assert figures["half precision", "float16"] > figures["SH degree", "1"]


def test_psnr_of_fewer_sh_is_that_of_a_scene_without_them(study: tuple[SpeedStudy, Path], studied: StudyScene) -> None:
    source, judge, renderer = studied.run.source, studied.judge, studied.bench.renderer
    planes = source.read(slice(0, COUNT), list(FIELD))
    planes["sh_rest"] = np.zeros((0, COUNT), np.float32)
    with renderer.load(MemorySource(planes, origin=source.origin)) as scene:
        images = [renderer.render(scene, camera) for camera in judge.cameras]
    wanted = mean_psnr([psnr(mse(image, judge.original(i))) for i, image in enumerate(images)])
    (row,) = (r for r in rows_of(study, "drawing") if (r["kind"], r["setting"]) == ("SH degree", "0"))
    assert row["psnr"] == pytest.approx(wanted, abs=2e-3)


def test_lower_degrees_and_half_precision_are_read_row_by_row() -> None:
    whole = random_scene(50, seed=1, degree=3)
    rows = np.array([3, 7, 40])
    rest = whole.read(rows, ["sh_rest"])["sh_rest"].reshape(3, 15, 3)
    lower = LowerDegree(whole, 1).read(rows, ["means", "sh_rest"])
    assert np.array_equal(lower["sh_rest"].reshape(3, 3, 3), rest[:, :3])
    assert np.array_equal(lower["means"], whole.read(rows, ["means"])["means"])
    assert LowerDegree(whole, 0).sh_count == 0
    half = HalfPrecision(whole).read(slice(2, 9), ["means"])["means"]
    assert np.array_equal(half, whole.read(slice(2, 9), ["means"])["means"].astype(np.float16).astype(np.float32))


def test_all_views_are_the_reference_of_a_few(study: tuple[SpeedStudy, Path], studied: StudyScene) -> None:
    rows = rows_of(study, "scoring")
    train = len(studied.views.train)
    assert [(row["score"], row["poses"], row["views"]) for row in rows if row["score"] == "gs"] == [
        ("gs", "covering", 4), ("gs", "farthest", 4), ("gs", "even", 4), ("gs", "all", train),
    ]  # fmt: skip
    for row in rows:
        assert (row["spearman"] == 1.0) == (row["poses"] == "all")
        assert len({r["size"] for r in rows}) == 1, "one size"
    # The paper's search found its answer by the same score.
    (whole,) = (row for row in rows if (row["score"], row["poses"]) == ("gs", "all"))
    found = studied.search.chosen
    assert whole["size"] == found.size and found.measurement is not None
    assert whole["drop"] == pytest.approx(found.measurement.drop, abs=1e-4)


def test_presets_are_runs_of_compress(study: tuple[SpeedStudy, Path], project: Path) -> None:
    row, other = rows_of(study, "presets")
    assert (other["method"], other["effort"]) == ("paper", "balanced") and float(str(other["seconds"])) > 0
    made = compress(project / "point_cloud.ply", None, replace(OPTIONS, method="paper"), dry_run=True, best_effort=True)
    assert (row["method"], row["size"], row["kept"]) == ("paper", made.size, made.count)
    assert made.quality is not None and row["drop"] == pytest.approx(made.quality.drop, abs=1e-4)


def test_only_the_parts_asked_for_are_made(project: Path, tmp_path: Path) -> None:
    found = study_speed(project / "point_cloud.ply", tmp_path / "out", OPTIONS, parts=["drawing"], repeats=1)
    assert [experiment.key for experiment in found.scene.experiments] == ["drawing"]
    assert len(list((tmp_path / "out").iterdir())) == 5


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ({"parts": ["drawing", "sleeping"]}, "--parts sleeping: expected one or more of drawing, scoring"),
        ({"parts": []}, "expected one or more of"),
        ({"repeats": 0}, "--repeats 0: expected 1 or more"),
    ],
)
def test_words_are_checked_before_any_work(tmp_path: Path, words: dict[str, object], said: str) -> None:
    with pytest.raises(InputError, match=said):
        study_speed(tmp_path / "none.ply", tmp_path / "out", **words)  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []


def test_beginnings_of_the_farthest_order_cover_the_whole() -> None:
    cameras = []
    for turn in np.linspace(0, 2 * np.pi, 16, endpoint=False):
        forward = np.array([np.cos(turn), np.sin(turn), 0.0])
        side = np.array([-forward[1], forward[0], 0.0])
        rotation = np.array([side, np.cross(forward, side), forward])
        cameras.append(make_camera(rotation=rotation, translation=tuple(rotation @ (3 * forward))))
    order = farthest_order(cameras)
    assert sorted(order) == list(range(16)) and order == farthest_order(cameras)
    # On a ring: opposite, then the quarters, then the eighths.
    assert abs(order[0] - order[1]) == 8 and sorted((i - order[0]) % 16 for i in order[:4]) == [0, 4, 8, 12]
    assert sorted((i - order[0]) % 16 for i in order[:8]) == list(range(0, 16, 2))
    assert farthest_order([]) == [] and farthest_order([cameras[3]] * 3) == [0, 1, 2]


def test_beginnings_of_the_covering_order_see_most() -> None:
    """Two clusters of points: one large, seen by two cameras from nearly one place and a third across, and one small."""
    back = np.diag([-1.0, 1.0, -1.0])
    rng = np.random.default_rng(5)
    large, small = rng.normal([[0.0], [0.0], [4.0]], 0.2, (3, 90)), rng.normal([[0.0], [0.0], [-4.0]], 0.2, (3, 30))
    points = np.hstack([large, small])
    across = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    cameras = [
        make_camera(64, 48, translation=(5.0, 0.0, 0.0)),  # looks past all
        make_camera(64, 48),
        make_camera(64, 48, translation=(0.0, 0.1, 0.0)),
        make_camera(64, 48, rotation=across, translation=tuple(-across @ [-4.0, 0.0, 4.0])),
        make_camera(64, 48, rotation=back),
    ]
    assert covering_order(cameras, points, 0.2, 9) == [1, 3, 2, 4, 0]
    assert covering_order(cameras, points, 0.2, 2) == [1, 3]
    # What is seen again from nearly the same place is worth half of it, and 45 points more than 30 elsewhere.
    assert covering_order([cameras[i] for i in (1, 2, 4)], points, 0.2, 3) == [0, 1, 2]
    assert covering_order([cameras[i] for i in (1, 2, 4)], points[:, 31:], 0.2, 3) == [0, 2, 1]
    # Moved, turned and in another unit they are the same scene.
    turn, place = look_from(1)[0], np.array([[1e4], [-2e4], [3e3]])
    moved = [
        replace(c, rotation=c.rotation @ turn.T, translation=10 * c.translation - c.rotation @ turn.T @ place[:, 0])
        for c in cameras
    ]
    assert covering_order(moved, 10 * turn @ points + place, 2.0, 9) == [1, 3, 2, 4, 0]
    assert covering_order([], points, 0.2, 3) == [] and covering_order(cameras, points[:, :0], 0.2, 2) == [0, 1]


def test_poses_that_only_turn_are_told_apart() -> None:
    turns = [look_from(seed)[0] for seed in range(5)]
    cameras = [make_camera(rotation=turn) for turn in [turns[0]] * 3 + turns[1:]]
    assert set(farthest_order(cameras)[:5]) & {0, 1, 2} and len(set(farthest_order(cameras)[:5]) & {0, 1, 2}) == 1


def test_ranks_share_their_mean_where_values_are_equal() -> None:
    # By hand: ranks 0.5, 0.5, 2, 3 against 0, 1, 2, 3; covariance 4.5, variances 4.5 and 5.
    assert spearman(np.array([1.0, 1.0, 2.0, 3.0]), np.arange(4.0)) == pytest.approx(4.5 / np.sqrt(4.5 * 5))
    assert spearman(np.array([-np.inf, -np.inf, 5.0]), np.array([0.0, 0.0, 1e9])) == 1.0


def test_fronts() -> None:
    assert front([3, 1, 2, 2], [9, 1, 5, 4]) == [True, True, True, False] and front([], []) == []
    assert front([1, 2], [float("inf"), float("inf")]) == [True, False]


def test_a_chart_shows_its_front_and_the_point_without_a_y() -> None:
    series = (Series("ways", [1.0, 10.0, 5.0], [20.0, 40.0, None], line=False),)
    chart = LineChart(
        "t", "ms", "dB", series, floating=True, log_x=True, front=[(10.0, 40.0), (1.0, 20.0)], upright=(20.0, "exact")
    )
    (axes,) = draw(chart).axes
    assert axes.get_xscale() == "log" and "exact" in [text.get_text() for text in axes.texts]
    lines = {line.get_label(): line.get_xydata().tolist() for line in axes.lines}
    assert lines["ways"] == [[1.0, 20.0], [10.0, 40.0]] and lines["Pareto front"][0] == [1.0, 20.0]
    both = replace(chart, log_y=True)
    assert draw(both).axes[0].get_yscale() == "log"


def test_the_command_line_hands_on_what_it_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], study: tuple[SpeedStudy, Path]
) -> None:
    told: dict[str, object] = {}

    def told_study(scene: str, output: str, options: CompressOptions, progress: object, **words: object) -> SpeedStudy:
        told.update(words, max_drop=options.max_drop, scene=scene)
        return study[0]

    monkeypatch.setattr("flexgs_edge.studies.speed.study.study_speed", told_study)
    words = [
        "study",
        "speed",
        "a.ply",
        "-o",
        str(tmp_path / "out"),
        "--parts",
        "drawing, scoring",
        "--repeats",
        "3",
        "-q",
    ]
    with pytest.raises(SystemExit) as left:
        app.main([*words, "--json", "-"])
    assert left.value.code == 0
    assert told == {"parts": ("drawing", "scoring"), "repeats": 3, "max_drop": 1.0, "scene": "a.ply"}
    assert json.loads(capsys.readouterr().out)["command"] == "study speed"


def test_help_teaches(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        app.main(["study", "speed", "--help"])
    assert left.value.code == 0 and "flexgs-edge study speed point_cloud.ply -o speed" in capsys.readouterr().out
    options = [option for option in command.params if isinstance(option, click.Option)]
    assert all(option.help and option.help.endswith(".") for option in options)
    defaults = {option.name: option.default for option in options}
    assert PARTS.convert(defaults["parts"], None, None) == speed.PARTS
    assert defaults["repeats"] == speed.REPEATS
