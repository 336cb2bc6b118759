"""Jobs end to end on a tiny scene with the NumPy twins."""

from __future__ import annotations

import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import flexgs_edge
from flexgs_edge.api import coding
from flexgs_edge.codec.v1.packed_source import FgsSource
from flexgs_edge.commands.compress import compress
from flexgs_edge.commands.decompress import decompress
from flexgs_edge.commands.evaluate import evaluate
from flexgs_edge.commands.info import info
from flexgs_edge.commands.render import render_views
from flexgs_edge.commands.verify import verify
from flexgs_edge.errors import InputError, TargetError
from flexgs_edge.io.ply import PlySource
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.report.results import CompressResult
from flexgs_edge.run.inputs import read_scene
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.scene.fields import FIELD
from tiny_project import COUNT, FAST, HEIGHT, VIEWS, WIDTH, compress_project, make_project


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_project(tmp_path_factory.mktemp("tiny") / "scene")


@pytest.fixture(scope="module")
def done(project: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, CompressResult]:
    folder = tmp_path_factory.mktemp("done")
    return folder, compress_project(project, folder)


@pytest.mark.parametrize("method", ["paper", "best"])
def test_the_twins_give_the_same_bytes(project: Path, tmp_path: Path, method: str) -> None:
    words = {**FAST, "method": method, "max_drop": 2.0}
    for name, device in (("a.fgs", None), ("b.fgs", "numpy")):
        result = compress(project / "point_cloud.ply", tmp_path / name, device=device, **words)
    assert "NumPy twins" in result.summary()
    assert (tmp_path / "a.fgs").read_bytes() == (tmp_path / "b.fgs").read_bytes()


def test_the_summary_figures_are_those_of_the_decoded_file(project: Path, done: tuple[Path, CompressResult]) -> None:
    folder, result = done
    assert result.size == os.stat(folder / "a.fgs").st_size
    assert result.reached and result.decided_by == "drop" and result.decision_views == "held-out"
    found = evaluate(folder / "a.fgs", project / "point_cloud.ply", holdout=4)
    assert result.quality is not None and found.quality.views == result.quality.views
    assert result.search is not None and result.search.chosen.measurement is not None
    # The search measured the same bits that the file decodes to.
    assert found.quality.drop == result.search.chosen.measurement.drop
    assert found.quality.drop is not None and found.quality.drop <= 2.0


def test_ratios_count_the_ply_as_inria_writes_it(done: tuple[Path, CompressResult]) -> None:
    _, result = done
    row = 4 * (3 + 3 + 3 + 9 + 1 + 3 + 4)
    assert result.scene.ply_bytes == COUNT * row
    assert result.ratio == COUNT * row / result.size
    assert result.ratio_without_normals == COUNT * (row - 12) / result.size


def test_what_was_found_beside_the_scene_is_named(project: Path, done: tuple[Path, CompressResult]) -> None:
    _, result = done
    assert result.views is not None
    assert (result.views.total, result.views.train, result.views.held_out) == (VIEWS, 6, 3)
    text = result.summary()
    for word in (project / "cameras.json", project / "images", "held-out views, which decide only where"):
        assert str(word) in text


def test_json_has_every_documented_key_and_no_infinity(done: tuple[Path, CompressResult]) -> None:
    _, result = done
    record = json.loads(json.dumps(result.to_json(), allow_nan=False))
    assert set(record) >= {
        "program", "command", "input", "views", "output", "size", "ratio", "ratio_without_normals", "count", "sh_count",
        "prune_rate", "sh_rate", "method", "score", "select", "bits", "groups", "target", "decided_by", "reached",
        "decision_views", "search", "quality", "quality_views", "run",
    }  # fmt: skip
    assert set(record["quality"]) == {
        "drop", "usual_drop", "fidelity", "modelled_drop", "base_psnr", "psnr", "original_psnr", "ssim",
        "original_ssim", "ssim_fidelity", "lpips", "original_lpips", "lpips_fidelity", "flip", "original_flip",
        "flip_fidelity", "worst_flip", "coverage", "covered_fidelity", "covered_modelled_drop", "covered_decides",
        "identical_views", "made", "worst", "views",
    }  # fmt: skip
    assert set(record["run"]) == {
        "seconds", "stages", "startup_ms", "compile_ms", "memory_limit", "peak_memory", "peak_anonymous", "scratch", "device",
    }  # fmt: skip
    assert record["search"] and all(step["seconds"] >= 0 for step in record["search"])
    assert list(record["run"]["stages"]) == [
        "open",
        "device",
        "check views",
        "fingerprint",
        "load",
        "references",
        "score",
        "search",
        "write",
        "measure",
    ]


def test_same_command_same_bytes(project: Path, done: tuple[Path, CompressResult], tmp_path: Path) -> None:
    folder, _ = done
    limit = MemoryBudget.from_limit(None).used + 120 * 2**20
    compress(project / "point_cloud.ply", tmp_path / "b.fgs", max_drop=2.0, memory_limit=limit, **FAST)
    data = (tmp_path / "b.fgs").read_bytes()
    assert data == (folder / "a.fgs").read_bytes()
    assert str(project).encode() not in data and b"numpy" not in data and b"seconds" not in data


def test_saved_scores_take_one_search(project: Path, done: tuple[Path, CompressResult], tmp_path: Path) -> None:
    folder, first = done
    scored = str(folder / "s.npz")
    result = compress(project / "point_cloud.ply", tmp_path / "b.fgs", max_drop=2.0, score_cache=scored, **FAST)
    assert "score" not in result.run.stages
    assert (result.prune_rate, result.sh_rate, result.size) == (first.prune_rate, first.sh_rate, first.size)
    assert (
        read_scene(tmp_path / "b.fgs").read(slice(0, 9), ["means"])["means"].tolist()
        == read_scene(folder / "a.fgs").read(slice(0, 9), ["means"])["means"].tolist()
    )


def test_decompress_gives_the_files_values(done: tuple[Path, CompressResult], tmp_path: Path) -> None:
    folder, _ = done
    result = decompress(folder / "a.fgs", tmp_path / "a.ply")
    coded, plain = FgsSource(folder / "a.fgs"), PlySource(tmp_path / "a.ply")
    assert result.size == os.stat(tmp_path / "a.ply").st_size and coded.count == plain.count
    rows = slice(0, coded.count)
    assert np.array_equal(coded.origin, plain.origin)
    for name in FIELD:
        assert np.array_equal(coded.read(rows, [name])[name], plain.read(rows, [name])[name]), name


def test_a_fixed_choice_has_no_search(project: Path, tmp_path: Path) -> None:
    result = compress(project / "point_cloud.ply", tmp_path / "a.fgs", prune_rate=0.25, sh_rate=0.5, **FAST)
    assert result.target is None and result.reached is None and result.search is not None
    assert len(result.search.steps) == 1 and result.count == COUNT - COUNT // 4
    assert result.sh_count == COUNT // 4
    assert "fixed rates" in result.summary()


def test_without_photos_the_modelled_drop_decides(project: Path, tmp_path: Path) -> None:
    result = compress(project / "point_cloud.ply", tmp_path / "a.fgs", images="none", max_drop=3.0, **FAST)
    assert result.decided_by == "modelled drop" and result.views is not None and result.views.images is None
    assert result.quality is not None and result.quality.drop is None and result.quality.modelled_drop <= 3.0
    assert "no photos decide" in result.summary()


def test_training_poses_decide_and_held_out_views_report(project: Path, tmp_path: Path) -> None:
    result = compress(project / "point_cloud.ply", tmp_path / "a.fgs", select="train", max_drop=3.0, **FAST)
    assert result.decided_by == "modelled drop" and result.decision_views == "training"
    assert result.quality_views == "held-out" and result.quality is not None and result.quality.drop is not None
    assert [view.name for view in result.quality.views] == ["v00", "v04", "v08"]
    assert result.search is not None and result.search.chosen.measurement is not None
    assert result.search.chosen.measurement.drop is None


def test_no_views_held_out(project: Path, tmp_path: Path) -> None:
    words = {**FAST, "holdout": 0}
    with pytest.raises(InputError, match="--holdout 0 leaves no view to decide on: use --select train"):
        compress(project / "point_cloud.ply", tmp_path / "a.fgs", **words)
    result = compress(project / "point_cloud.ply", tmp_path / "a.fgs", select="train", min_fidelity=20.0, **words)
    assert result.quality_views == "training" and result.decided_by == "fidelity"


@pytest.mark.parametrize("words", [{"max_size": 9000}, {"min_ratio": 4.0}])
def test_size_targets(project: Path, tmp_path: Path, words: dict[str, Any]) -> None:
    result = compress(project / "point_cloud.ply", tmp_path / "a.fgs", **words, **FAST)
    limit = words.get("max_size", int(result.scene.ply_bytes / 4.0))
    assert result.decided_by == "size" and os.stat(tmp_path / "a.fgs").st_size <= limit
    assert result.size > 0.9 * limit


def test_a_dry_run_writes_nothing_and_says_the_size(
    project: Path, done: tuple[Path, CompressResult], tmp_path: Path
) -> None:
    result = compress(project / "point_cloud.ply", None, max_drop=2.0, dry_run=True, **FAST)
    assert result.output is None and result.size == done[1].size and result.quality == done[1].quality
    assert list(tmp_path.iterdir()) == [] and "nothing was written" in result.summary()


def test_an_unreachable_target_leaves_nothing(project: Path, tmp_path: Path) -> None:
    with pytest.raises(TargetError, match="cannot be reached: the closest point is"):
        compress(project / "point_cloud.ply", tmp_path / "a.fgs", min_fidelity=150.0, **FAST)
    assert list(tmp_path.iterdir()) == []
    result = compress(project / "point_cloud.ply", tmp_path / "a.fgs", min_fidelity=150.0, best_effort=True, **FAST)
    assert result.reached is False and (tmp_path / "a.fgs").is_file()
    assert "NOT reached" in result.summary() and info(tmp_path / "a.fgs").settings["reached"] is False


@pytest.mark.parametrize(
    ("bits", "expected"), [("rtn8", {"xyz": 8, "dc": 8, "rest": 8}), ("xyz=12,rest=2", {"xyz": 12, "rest": 2, "dc": 8})]
)
def test_bits(project: Path, tmp_path: Path, bits: str, expected: dict[str, int]) -> None:
    result = compress(project / "point_cloud.ply", tmp_path / "a.fgs", bits=bits, prune_rate=0, sh_rate=0, **FAST)
    assert result.score is None  # nothing is pruned: no score is needed
    assert {name: result.bits[name] for name in expected} == expected
    assert set(result.groups.values()) == {1}


def test_views_of_a_lone_scene_are_made_from_it(tmp_path: Path, project: Path) -> None:
    lonely = tmp_path / "scene.ply"
    lonely.write_bytes((project / "point_cloud.ply").read_bytes())
    words: dict[str, Any] = {"resolution": 32, "method": "paper", "prune_rate": 0.2, "sh_rate": 0.2}
    alone = compress(lonely, tmp_path / "a.fgs", **words)
    asked = compress(project / "point_cloud.ply", tmp_path / "b.fgs", cameras="auto", **words)
    assert (tmp_path / "a.fgs").read_bytes() == (tmp_path / "b.fgs").read_bytes()
    for result in (alone, asked):
        assert result.views is not None and result.views.cameras == "auto" and result.views.images is None
        assert result.views.total >= 40 and result.views.width == 32
        assert result.views.held_out == -(-result.views.total // 8)
        assert any("automatic views" in note for note in result.views.notes)
        assert result.quality is not None and result.quality.drop is None
    text = alone.summary()
    assert "cameras from auto" in text and "automatic views" in text


def test_cameras_of_other_programs_beside_the_scene(tmp_path: Path, project: Path) -> None:
    scene = tmp_path / "scene.ply"
    scene.write_bytes((project / "point_cloud.ply").read_bytes())
    (tmp_path / "images").symlink_to(project / "images")
    lens = {"w": WIDTH, "h": HEIGHT, "fl_x": 40.0, "fl_y": 40.0, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    pose = [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, -5], [0, 0, 0, 1]]
    frames = [{"file_path": f"images/v{i:02}.png", "transform_matrix": pose} for i in range(VIEWS)]
    rates: dict[str, Any] = {"method": "paper", "prune_rate": 0, "sh_rate": 0, "dry_run": True, "trust_views": True}
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    found = compress(scene, None, **rates).views
    assert found is not None and found.cameras == str(tmp_path / "transforms.json") and found.images is not None
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "k1": 0.05, "frames": frames}))
    found = compress(scene, None, **rates).views
    assert found is not None and found.images is not None
    found = compress(scene, None, ignore_distortion=True, **rates).views
    assert found is not None and found.images is None and found.total == VIEWS
    assert any("9 cameras have lens distortion" in note for note in found.notes)
    with pytest.raises(InputError, match="photos cannot be compared"):
        compress(scene, None, ignore_distortion=True, images=str(tmp_path / "images"), **rates)


def test_render_draws_the_chosen_views(project: Path, tmp_path: Path) -> None:
    result = render_views(project / "point_cloud.ply", tmp_path / "out", views=[0, 8, 8, 3])
    assert [Path(file).name for file in result.files] == ["v00.png", "v08.png", "v03.png"]
    photo = np.asarray(Image.open(project / "images" / "v03.png"), np.float64)
    image = np.asarray(Image.open(tmp_path / "out" / "v03.png"), np.float64)
    assert image.shape == (HEIGHT, WIDTH, 3) and np.abs(image - photo).mean() < 8
    record = result.to_json()
    assert record["ms_per_view"] > 0 and {"startup_ms", "compile_ms", "view_ms"} <= set(record)
    with pytest.raises(InputError, match="exists"):
        render_views(project / "point_cloud.ply", tmp_path / "out", views=[3])
    with pytest.raises(InputError, match="no view 9; the 9 views are 0 to 8"):
        render_views(project / "point_cloud.ply", tmp_path / "out", views=[9])
    with pytest.raises(InputError, match="expected a folder"):
        render_views(project / "point_cloud.ply", project / "cameras.json")


def test_a_file_remembers_how_it_is_drawn(project: Path, tmp_path: Path) -> None:
    compress(
        project / "point_cloud.ply",
        tmp_path / "a.fgs",
        prune_rate=0,
        sh_rate=0,
        background=(0.0, 0.5, 1.0),
        near=1.5,
        **FAST,
    )
    cameras = str(project / "cameras.json")
    render_views(tmp_path / "a.fgs", tmp_path / "kept", cameras=cameras, views=[0])
    render_views(
        tmp_path / "a.fgs",
        tmp_path / "told",
        cameras=cameras,
        views=[0],
        device="numpy",
        near=1.5,
        background=(0, 0.5, 1),
    )
    render_views(tmp_path / "a.fgs", tmp_path / "other", cameras=cameras, views=[0], background=(0, 0, 0))
    kept, told, other = ((tmp_path / name / "v00.png").read_bytes() for name in ("kept", "told", "other"))
    assert kept == told != other


def test_a_scene_against_itself_is_identical(project: Path) -> None:
    found = evaluate(project / "point_cloud.ply", project / "point_cloud.ply", holdout=0)
    assert found.quality.fidelity is None and found.quality.drop == 0.0 and found.quality.identical == VIEWS
    record = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert record["quality"]["fidelity"] is None and record["quality"]["ssim"] is not None
    assert record["quality_views"] == "training"


def test_resolution_scales_views_and_says_so(project: Path) -> None:
    found = evaluate(project / "point_cloud.ply", project / "point_cloud.ply", resolution=20)
    assert (found.views.width, found.views.height) == (20, 15) and "scaled down" in found.views.notes[0]


def test_info_of_a_file_adds_up(done: tuple[Path, CompressResult]) -> None:
    folder, result = done
    found = info(folder / "a.fgs")
    assert found.count == result.count and found.sh_count == result.sh_count
    assert sum(item["bytes"] for item in found.channels.values()) + found.overhead_bytes == result.size
    assert found.settings["target"] == "drop <= 2 dB" and found.settings["reached"] is True
    assert found.ratio == pytest.approx(result.ratio, abs=1e-3)
    json.dumps(found.to_json(), allow_nan=False)
    text = found.summary()
    for word in ("bits", "rest", "target: drop <= 2 dB", f"{result.count}"):
        assert word in text


def test_info_of_a_ply_names_its_companions(project: Path) -> None:
    found = info(project / "point_cloud.ply")
    assert found.format == "ply" and found.count == COUNT and found.sh_degree == 1
    assert str(project / "cameras.json") in found.summary()


def test_verify_names_the_damaged_part(done: tuple[Path, CompressResult], tmp_path: Path) -> None:
    folder, _ = done
    assert verify(folder / "a.fgs").ok
    data = bytearray((folder / "a.fgs").read_bytes())
    data[-200] ^= 1
    (tmp_path / "a.fgs").write_bytes(data)
    assert verify(tmp_path / "a.fgs").damaged == ("chunk 0",)
    with pytest.raises(InputError, match=r"expected a \.fgs file"):
        verify(folder / "s.npz")


def test_a_compressed_file_can_be_compressed_again(
    project: Path, done: tuple[Path, CompressResult], tmp_path: Path
) -> None:
    words = {**FAST, "cameras": str(project / "cameras.json")}
    result = compress(done[0] / "a.fgs", tmp_path / "b.fgs", prune_rate=0.5, sh_rate=0.2, **words)
    assert result.scene.count == done[1].count and result.size < done[1].size


def test_the_api_has_the_words_of_the_command_line() -> None:
    for name in flexgs_edge.__all__:
        assert getattr(flexgs_edge, name) is not None
    assert set(flexgs_edge.__all__) <= set(dir(flexgs_edge))
    with pytest.raises(AttributeError, match="attribute nothing"):
        _ = flexgs_edge.nothing
    assert flexgs_edge.compress is coding.compress
    assert "max_drop" in asdict(CompressOptions())
