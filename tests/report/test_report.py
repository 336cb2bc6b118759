"""`--report`: what the page says and shows, that names cannot break it, and what is refused or left behind."""

from __future__ import annotations

import io
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.cli import app
from flexgs_edge.commands.compress import compress
from flexgs_edge.commands.evaluate import evaluate
from flexgs_edge.errors import BudgetError, InputError, TargetError
from flexgs_edge.goals.steps import Choice, SearchResult, Step
from flexgs_edge.goals.target import MaxDrop, MaxSize, Measurement
from flexgs_edge.kernels.tested import open_backend
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.progress import Stopwatch
from flexgs_edge.quality.similarity import flip_maps
from flexgs_edge.quality.view_quality import Quality, ViewQuality
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.report.pages import (
    FLIP_SCALE,
    Material,
    Shot,
    compress_page,
    error_map,
    evaluate_page,
    ramp,
    step_chart,
)
from flexgs_edge.report.results import CompressResult, EvaluateResult
from flexgs_edge.report.run_info import RunInfo, SceneInfo, ViewsInfo
from flexgs_edge.run.inputs import companions_of
from flexgs_edge.run.reporter import Reporter, encode
from page_parser import Page
from scene_files import open_scene
from tiny_project import HEIGHT, WIDTH, make_project, write_cameras

FAST: dict[str, Any] = {"effort": "fast", "holdout": 4}
RUN = RunInfo(1.25, {"open": 0.25, "measure": 1.0}, 0.5, 0.125, 2**30, 2**28, {"name": "a <b> device", "platform": "p"})
EVIL = "<script>alert(1)</script>\"'&\udcff\x07\u202e.ply"


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_project(tmp_path_factory.mktemp("tiny") / "scene")


@pytest.fixture(scope="module", params=["paper", "best"])
def done(
    request: pytest.FixtureRequest, project: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, CompressResult, Page]:
    """The tiny scene compressed against its photos, with a report, by both methods."""
    folder = tmp_path_factory.mktemp("done")
    options = {"max_drop": 3.0, "method": request.param, **FAST}
    result = compress(project / "point_cloud.ply", folder / "a.fgs", report=str(folder / "page"), **options)
    return folder, result, read_page(folder / "page")


def read_page(folder: Path) -> Page:
    page = Page((folder / "index.html").read_text(encoding="utf-8"))
    assert not page.unbalanced and not page.open and page.fetched() == []
    return page


def test_the_folder_holds_the_page_and_the_record_of_json(done: tuple[Path, CompressResult, Page]) -> None:
    folder, result, _ = done
    assert sorted(path.name for path in (folder / "page").iterdir()) == ["index.html", "result.json"]
    assert json.loads((folder / "page" / "result.json").read_text()) == json.loads(json.dumps(result.to_json()))


def test_the_page_tells_what_the_record_holds(done: tuple[Path, CompressResult, Page]) -> None:
    folder, result, page = done
    assert result.quality is not None and result.search is not None and result.views is not None
    size = f"{result.size:,}".replace(",", "\u202f")
    for words in (
        f"{result.ratio:.2f}\u00d7",
        f"{result.quality.flip_original:.4f} FLIP against the original",
        f"{size} bytes",
        f"{result.quality.drop:.2f} dB of PSNR were lost",
        str(folder / "a.fgs"),
        f"Target: {result.target}. Reached after {len(result.search.steps)} steps",
        "decided by the drop against the photos",
        result.views.cameras,
        "9 of 40\u00d730: 6 training, 3 held out",
        f"method {result.method}",
    ):
        assert words in page.text, words
    views, steps, channels, stages = page.cells
    assert [row[0] for row in views[1:]] == [result.quality.views[i].name for i in result.quality.by_loss]
    drops = [float(row[1]) for row in views[1:]]
    assert drops == sorted(drops, reverse=True)
    assert [row[5] for row in steps[1:]].count("chosen") == 1 and len(steps) == 1 + len(result.search.steps)
    assert sum(int(row[2].replace("\u202f", "")) for row in channels[1:]) == pytest.approx(
        result.size, abs=len(channels)
    )
    assert [row[0] for row in stages[1:]] == list(result.run.stages) and "pictures" in result.run.stages


def test_pictures_are_of_the_original_and_of_the_decoded_file(
    done: tuple[Path, CompressResult, Page], project: Path
) -> None:
    folder, result, page = done
    assert result.quality is not None
    budget = MemoryBudget(2**31)
    renderer = Renderer(open_backend(None, budget), budget)
    cameras = {camera.name: camera for camera in read_cameras(project / "cameras.json")}
    worst_first = [cameras[result.quality.views[i].name] for i in result.quality.by_loss]
    renders = {}
    for kind, path in (("original", project / "point_cloud.ply"), ("compressed", folder / "a.fgs")):
        with renderer.load(open_scene(path)) as scene:
            renders[kind] = [np.clip(renderer.render(scene, camera), 0, 1) for camera in worst_first]
    originals, decoded, errors, seen = (page.pictures(kind) for kind in ("original", "compressed", "error", "flip"))
    assert len(originals) == len(decoded) == len(errors) == len(seen) == len(page.pictures("photo")) == 3
    for i in range(3):
        # The same bits give the same JPEG: no tolerance could tell the scenes apart where little was lost.
        assert np.array_equal(originals[i], shown(encode(renders["original"][i], (WIDTH, HEIGHT))))
        assert np.array_equal(decoded[i], shown(encode(renders["compressed"][i], (WIDTH, HEIGHT))))
        assert not np.array_equal(decoded[i], originals[i])
        expected = ramp()[np.rint(255 * error_map(*(renders[k][i] for k in renders))).astype(int)] / 255
        assert np.abs(errors[i] - expected).mean() < 0.05
        (flip,) = flip_maps(renderer.backend, [(renders["compressed"][i], renders["original"][i])])
        assert np.abs(seen[i] - ramp()[np.rint(255 * np.minimum(flip / FLIP_SCALE, 1)).astype(int)] / 255).mean() < 0.05
        assert flip.mean(dtype=float) == result.quality.views[result.quality.by_loss[i]].flip_original


def shown(jpeg: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(jpeg)), np.float64) / 255


def test_encoding_keeps_places_and_colours_and_scales_by_area() -> None:
    x, y = np.meshgrid(np.linspace(0, 1, 96), np.linspace(0, 1, 64))
    image = np.stack([x, y, 1.2 - x], axis=2).astype(np.float32)
    same, half = shown(encode(image, (96, 64))), shown(encode(image, (48, 32)))
    assert np.abs(same - np.clip(image, 0, 1)).max() < 0.02
    assert np.abs(half - np.clip(image, 0, 1).reshape(32, 2, 48, 2, 3).mean(axis=(1, 3))).max() < 0.02


def test_a_dry_run_shows_what_the_file_would_decode_to(
    done: tuple[Path, CompressResult, Page], project: Path, tmp_path: Path
) -> None:
    _, result, page = done
    options = {"max_drop": 3.0, "method": result.method, **FAST}
    dry = compress(project / "point_cloud.ply", None, dry_run=True, report=str(tmp_path / "page"), **options)
    assert dry.size == result.size and [path.name for path in tmp_path.iterdir()] == ["page"]
    shown = read_page(tmp_path / "page")
    assert "A dry run" in shown.text
    for kind in ("original", "compressed", "error", "flip", "photo"):
        assert all(np.array_equal(a, b) for a, b in zip(shown.pictures(kind), page.pictures(kind), strict=True))
    assert shown.cells[2] == page.cells[2], "bytes of the channels"


def test_identical_scenes_without_photos(project: Path, tmp_path: Path) -> None:
    scene = project / "point_cloud.ply"
    evaluate(scene, scene, images="none", report=tmp_path / "page", holdout=0)
    page = read_page(tmp_path / "page")
    assert (
        "The renders are identical (mean over 9 training views)" in page.text and "there are no photos" not in page.text
    )
    assert len(page.pictures("original")) == 5 and page.pictures("photo") == []
    for original, same, error in zip(*(page.pictures(kind) for kind in ("original", "compressed", "error"))):
        assert np.array_equal(original, same)
        assert np.abs(error - ramp()[0] / 255).max() < 0.02, "no error is the darkest colour"
    assert all(row[1] == "identical" for row in page.cells[0][1:])
    assert not [item for item in page.named("input") if item.get("value") == "photo"]


def test_one_view_and_photos_larger_than_the_page_shows(project: Path, tmp_path: Path) -> None:
    (cameras,) = json.loads(write_cameras(tmp_path / "one.json", 1).read_text())
    factor = 30
    for word in ("width", "height", "fx", "fy"):
        cameras[word] *= factor
    (tmp_path / "one.json").write_text(json.dumps([cameras]))
    scene = project / "point_cloud.ply"
    evaluate(scene, scene, cameras=str(tmp_path / "one.json"), report=tmp_path / "page", holdout=0)
    page = read_page(tmp_path / "page")
    assert WIDTH * factor == 1200 and page.pictures("original")[0].shape == (HEIGHT * 800 // WIDTH, 800, 3)
    assert "The only view: v00" in page.text and "mean over 1 training view)" in page.text


def test_fixed_rates_have_no_search_and_no_views_no_pictures(project: Path, tmp_path: Path) -> None:
    (tmp_path / "lone.ply").write_bytes((project / "point_cloud.ply").read_bytes())
    rates: dict[str, Any] = {"method": "paper", "prune_rate": 0.3, "sh_rate": 0.2}
    compress(project / "point_cloud.ply", tmp_path / "a.fgs", report=str(tmp_path / "seen"), **rates, **FAST)
    page = read_page(tmp_path / "seen")
    assert "fixed rates, nothing was searched" in page.text and len(page.pictures("photo")) == 3
    assert page.named("svg", "chart") == []
    compress(
        tmp_path / "lone.ply",
        tmp_path / "b.fgs",
        report=str(tmp_path / "blind"),
        cameras="none",
        method="paper",
        prune_rate=0.0,
        sh_rate=0.0,
        **FAST,
    )
    page = read_page(tmp_path / "blind")
    assert "not measured: no cameras" in page.text and page.named("img") == [] and page.named("svg") == []
    assert "headers and checksums" in page.text


def hand_made(name: str, **changes: Any) -> tuple[CompressResult, Material]:
    """A result with `name` wherever a name can stand."""
    scene = SceneInfo(name, 10, 3, 2480, 2360, (f"note {name}",))
    views = ViewsInfo(name, name, 2, 1, 1, 4, 3, (f"note on views {name}",))
    steps = tuple(
        Step(Choice(100 * i, 100), 900 - 50 * i, Measurement(0.3 * i, 40.0, 0.3 * i), i - 2.5, "list", 0.5)
        for i in (1, 2, 3)
    )
    result = CompressResult(
        scene, views, name, 100, 7, 3, 0.3, 0.4, "paper", name, "test", {"xyz": 16}, {"xyz": 1}, None, f"drop <= {name}",
        "drop", True, "held-out", SearchResult(steps[1], True, steps), Quality((ViewQuality(name, 1e-3, 2e-3, 1e-3),)),
        "held-out", None, False, RUN,
    )  # fmt: skip
    shot = Shot(0, 0, 0, 1, 4, 3, b"a", b"b", b"c", b"f", b"d")
    contents = {
        "size": 100, "version": 2, "overhead_bytes": 1, "bits_per_gaussian": 80.0, "ratio": 24.8,
        "channels": {name: {"bytes": 99, "rows": 7, "step": None, "bits_per_row": None}},
    }  # fmt: skip
    return replace(result, **changes), Material((shot,), contents, MaxDrop(1.0))


@pytest.mark.parametrize(
    ("given", "title", "tile"),
    [
        (None, "24.8 times smaller", "2.48 kB of PLY became 100 B."),
        (3000, "24.8 times smaller", "2.48 kB of PLY became 100 B."),
        (250, "2.5 times smaller", "250 B became 100 B."),
        (50, "2.0 times larger", "50 B became 100 B."),
    ],
)
def test_the_page_compares_with_the_input_file(given: int | None, title: str, tile: str) -> None:
    result, material = hand_made("a.sog")
    page = Page(compress_page(replace(result, scene=replace(result.scene, bytes=given)), material))
    assert title in page.text and tile in page.text
    times, word = title.split(" times ")
    assert f"{float(times):.2f}\u00d7 {word}" in " ".join(page.text.split())
    assert "24.80 times smaller" in page.text  # than a PLY
    assert ("than the input" in page.text) == (given in (250, 50))


def test_no_name_gets_out_of_its_place() -> None:
    result, material = hand_made(EVIL)
    other = EvaluateResult(result.scene, result.scene, result.views, result.quality, "held-out", RUN)  # type: ignore[arg-type]
    for html in (compress_page(result, material), evaluate_page(other, material)):
        html.encode("utf-8")
        plain = Page(evaluate_page(other, material) if "against" in html[:900] else compress_page(*hand_made("n")))
        page = Page(html)
        assert not page.unbalanced and page.fetched() == []
        assert len(page.named("script")) == 1 and "alert(1)" not in re.findall(r"<script>.*?</script>", html, re.S)[0]
        shown = "<script>alert(1)</script>\"'&\ufffd\ufffd\ufffd.ply"
        assert page.text.count(shown) >= 8, "shown as it is, but for what HTML cannot hold"
        assert [tag for tag, _ in page.tags] == [tag for tag, _ in plain.tags], "no tag more than with a plain name"
        assert all(set(a) == set(b) for (_, a), (_, b) in zip(page.tags, plain.tags)), "and no attribute"
        assert not re.search("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u202a-\u202e]", html)


def test_a_gain_is_not_called_a_loss() -> None:
    result, material = hand_made("n", quality=Quality((ViewQuality("n", 1e-3, 1e-3, 2e-3),)))
    assert "PSNR rose by 3.01 dB (mean over 1 held-out view)" in Page(compress_page(result, material)).text


def test_odd_bytes_in_real_paths(project: Path, tmp_path: Path) -> None:
    place = tmp_path / "a<b>&\"'\udcff"
    place.mkdir()
    scene = project / "point_cloud.ply"
    compress(scene, place / "s.fgs", report=str(place / "p"), method="paper", prune_rate=0.3, sh_rate=0.2, **FAST)
    assert "a<b>&\"'\ufffd/s.fgs" in read_page(place / "p").text


def test_a_missed_target_is_said(project: Path, tmp_path: Path) -> None:
    options: dict[str, Any] = {"method": "paper", "max_size": 1200, **FAST}
    with pytest.raises(TargetError):
        compress(project / "point_cloud.ply", tmp_path / "a.fgs", report=str(tmp_path / "page"), **options)
    assert list(tmp_path.iterdir()) == [], "nothing is left behind"
    compress(
        project / "point_cloud.ply", tmp_path / "a.fgs", report=str(tmp_path / "page"), best_effort=True, **options
    )
    page = read_page(tmp_path / "page")
    assert "was not reached: this is the closest point" in page.text and page.named("p", "warn")


def test_the_folder_is_checked_before_any_work(project: Path, tmp_path: Path) -> None:
    scene, out = tmp_path / "no such.ply", tmp_path / "a.fgs"
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "index.html").write_text("mine")
    (tmp_path / "file").write_text("")
    (tmp_path / "odd" / "result.json").mkdir(parents=True)
    # The scene does not exist: an error about the report shows that it was looked at first.
    for place, force, words in (
        (tmp_path / "full", False, "index.html: the file exists"),
        (tmp_path / "file", True, "expected a folder, found a file"),
        (tmp_path / "no" / "deep", True, "does not exist; make it first"),
        (tmp_path / "odd", True, "result.json: expected a file name"),
    ):
        with pytest.raises(InputError, match=words):
            compress(scene, out, report=str(place), force=force)
        with pytest.raises(InputError, match=words):
            evaluate(scene, scene, report=place, force=force)
    assert (tmp_path / "full" / "index.html").read_text() == "mine" and not out.exists()
    evaluate(project / "point_cloud.ply", project / "point_cloud.ply", holdout=4, report=tmp_path / "full", force=True)
    assert "identical" in read_page(tmp_path / "full").text


def test_a_report_that_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    result, _ = hand_made("n")
    broken = replace(result, prune_rate=float("nan"))  # JSON has no such number: found when the folder is there already
    (tmp_path / "old").mkdir()
    for folder in ("new", "old"):
        with pytest.raises(ValueError, match="nan"):
            Reporter(tmp_path / folder, False).write(broken)
    assert [path.name for path in tmp_path.iterdir()] == ["old"] and list((tmp_path / "old").iterdir()) == []


def test_pictures_are_taken_from_the_budget(project: Path) -> None:
    from flexgs_edge.run.options import ViewOptions
    from flexgs_edge.run.view_set import find_views

    source = open_scene(project / "point_cloud.ply")
    views = find_views(ViewOptions(background=(0.0, 0.0, 0.0)), companions_of(project), source)
    assert views is not None
    views = replace(views, held_out=[])
    budget = MemoryBudget(WIDTH * HEIGHT * 5 * 5)
    Reporter(project / "page", False).reserve(budget, views)
    assert budget.free == 0
    with pytest.raises(BudgetError, match="pictures of the report"):
        Reporter(project / "page", False).reserve(budget, views)


def test_the_command_line_takes_a_report(project: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def run(*words: object) -> tuple[int, str]:
        with pytest.raises(SystemExit) as left:
            app.main(
                [
                    "evaluate",
                    str(project / "point_cloud.ply"),
                    "--against",
                    str(project / "point_cloud.ply"),
                    *map(str, words),
                ]
            )
        return int(left.value.code or 0), capsys.readouterr().err

    code, words = run("--report", tmp_path / "p", "--json", tmp_path / "p" / "result.json")
    assert code == 2 and "leave --json out" in words and not (tmp_path / "p").exists()
    code, words = run("--report", tmp_path / "p")
    assert code == 0 and f"wrote the report {tmp_path / 'p' / 'index.html'}" in words
    code, words = run("--report", tmp_path / "p")
    assert code == 2 and "use -f to overwrite" in words


def test_chart_has_a_mark_a_step_and_the_target_between() -> None:
    result, _ = hand_made("n")
    assert result.search is not None
    page = Page(step_chart(result.search.steps, result.search.chosen, MaxDrop(0.75)))
    marks = page.named("circle", "step")[:3]  # those of the key follow
    heights = [float(mark["cy"]) for mark in marks]
    chosen = page.named("circle", "chosen")[0]
    assert (chosen["cx"], chosen["cy"]) == (marks[1]["cx"], marks[1]["cy"])
    line = float(page.named("path", "target")[0]["d"].split()[1].split("H")[0])
    assert heights[0] > heights[1] > line > heights[2], "drops .3 and .6 below the line, .9 above"
    assert line - heights[2] == pytest.approx(heights[1] - line, abs=0.2)
    assert [mark["class"] for mark in marks] == ["step holds", "step holds", "step"]
    upright = Page(step_chart(result.search.steps, result.search.chosen, MaxSize(825, "drop"))).named("path", "target")[
        0
    ]
    at = float(upright["d"].removeprefix("M").split()[0])
    assert float(marks[1]["cx"]) < at < float(marks[0]["cx"]), "between 800 and 850 bytes"


def test_views_are_ordered_by_what_they_lost() -> None:
    views = (ViewQuality("a", 3e-4, 2e-3, 1e-3), ViewQuality("b", 1e-4, 4e-3, 1e-3), ViewQuality("c", 2e-4, 1e-3, 1e-3))
    assert Quality(views).by_loss == [1, 0, 2]
    assert Quality(tuple(replace(view, photo_error=None) for view in views)).by_loss == [0, 2, 1]
    assert Quality(()).by_loss == []


def test_stages_within_stages_are_counted_once() -> None:
    clock = Stopwatch()
    with clock.stage("outer"):
        with clock.stage("inner"):
            for _ in range(200_000):
                pass
        with clock.stage("inner"):
            pass
    assert list(clock.stages) == ["outer", "inner"]
    assert 0 <= clock.stages["outer"] < clock.stages["inner"] and sum(clock.stages.values()) <= clock.total
