"""`compress` by measured costs, end to end: the bundled scene on OpenCL, and a tiny one."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexgs_edge.codec.open_fgs import file_version, verify
from flexgs_edge.codec.v2.encode import encode_grid
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.commands.compress import compress
from flexgs_edge.commands.evaluate import evaluate
from flexgs_edge.commands.info import info
from flexgs_edge.commands.trim import trim
from flexgs_edge.errors import BudgetError, InputError, TargetError
from flexgs_edge.grid.grid_scene import from_grid
from flexgs_edge.io.ply import write_ply
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.methods.best.grid_coder import GridCoder, bit_model
from flexgs_edge.methods.best.layers import can_sort
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.report.results import CompressResult
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.scene.check import alive
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import GrownSource, MemorySource
from grid_scenes import make_grid
from kernel_fixtures import large_budget, open_form
from scene_files import open_scene
from stopped import Stopped
from synthetic import random_scene
from tiny_project import COUNT, make_project

BEST: dict[str, Any] = {"method": "best", "effort": "fast", "promise": "mean"}
SMALL: dict[str, Any] = {**BEST, "resolution": 120}
TINY: dict[str, Any] = {**BEST, "holdout": 4}
ROOM = 1536  # bytes


@pytest.fixture(scope="module")
def sample(sample_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, CompressResult]:
    """The sample at a quarter of its width, drop of at most 1 dB against the photos."""
    path = tmp_path_factory.mktemp("sample") / "a.fgs"
    return path, compress(sample_dir / "point_cloud.ply", path, max_drop=1.0, **SMALL)


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_project(tmp_path_factory.mktemp("tiny") / "scene")


@pytest.fixture(scope="module")
def tiny(project: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, CompressResult]:
    path = tmp_path_factory.mktemp("done") / "a.fgs"
    return path, compress(project / "point_cloud.ply", path, max_drop=1.0, **TINY)


def test_the_sample_holds_its_drop_on_the_decoded_file(sample: tuple[Path, CompressResult], sample_dir: Path) -> None:
    path, result = sample
    assert result.reached and result.decided_by == "drop" and result.size == path.stat().st_size
    found = evaluate(path, sample_dir / "point_cloud.ply", resolution=120)
    assert result.quality is not None and found.quality.views == result.quality.views
    assert found.quality.drop is not None and found.quality.drop <= 1.0
    # The search measured the same bits that the file decodes to.
    assert result.search is not None and found.quality.usual_drop == result.search.chosen.measurement.drop  # type: ignore[union-attr]
    assert result.ratio > 40, result.ratio


def test_the_sample_reads_back(sample: tuple[Path, CompressResult]) -> None:
    path, result = sample
    assert file_version(path) == 2 and all(section.ok for section in verify(path))
    source = open_scene(path)
    assert isinstance(source, GridSource)
    planes = source.read(slice(0, source.count), list(FIELD))
    assert all(np.isfinite(values).all() for values in planes.values())
    assert (source.count, source.grid().sh_count) == (result.count, result.sh_count)
    assert result.steps is not None and result.steps == source.container.header.steps
    assert source.settings["method"] == "best" and source.settings["reached"] is True
    found = info(path)
    assert (found.count, found.sh_count, found.size) == (result.count, result.sh_count, result.size)
    assert sum(channel["bytes"] for channel in found.channels.values()) + found.overhead_bytes == result.size


def test_same_command_same_bytes_whatever_the_memory(
    sample: tuple[Path, CompressResult], sample_dir: Path, tmp_path: Path
) -> None:
    limit = MemoryBudget.from_limit(None).used + 330 * 2**20
    again = compress(sample_dir / "point_cloud.ply", tmp_path / "b.fgs", max_drop=1.0, memory_limit=limit, **SMALL)
    data = (tmp_path / "b.fgs").read_bytes()
    assert data == sample[0].read_bytes() and again.run.memory_limit == limit
    assert str(sample_dir).encode() not in data and b"seconds" not in data


def test_the_settings_fit_the_room_that_the_search_counts(sample: tuple[Path, CompressResult]) -> None:
    source = GridSource(sample[0])
    header = len(json.dumps(source.settings))
    assert header < ROOM
    # What the search counted is never below the file: a size target cannot be broken by its settings.
    coder = GridCoder(Renderer(open_form("w16"), large_budget()), ROOM)
    counted, bits = coder.size(source.grid()), coder.bits(source.grid())
    assert 0 <= counted - sample[1].size <= ROOM
    assert bits.base > 20 and all(band > 0 for band in bits.bands)


def test_the_tiny_scene_holds_its_drop(project: Path, tiny: tuple[Path, CompressResult]) -> None:
    path, result = tiny
    assert result.reached and result.size == path.stat().st_size
    found = evaluate(path, project / "point_cloud.ply", holdout=4)
    assert result.quality is not None and found.quality.views == result.quality.views
    assert found.quality.drop is not None and found.quality.drop <= 1.0
    assert list(result.run.stages) == [
        "open",
        "device",
        "check views",
        "load",
        "references",
        "search",
        "write",
        "measure",
    ]
    record = json.loads(json.dumps(result.to_json(), allow_nan=False))
    assert record["method"] == "best" and record["score"] is None and record["steps"]["position"] > 0
    assert record["search"] and all(step["phase"] == "multiplier" for step in record["search"])
    text = result.summary()
    assert f"{result.size} bytes" in text and "drop" in text


def test_the_tiny_scene_again_and_without_writing(
    project: Path, tiny: tuple[Path, CompressResult], tmp_path: Path
) -> None:
    limit = MemoryBudget.from_limit(None).used + 120 * 2**20
    compress(project / "point_cloud.ply", tmp_path / "b.fgs", max_drop=1.0, memory_limit=limit, **TINY)
    assert (tmp_path / "b.fgs").read_bytes() == tiny[0].read_bytes()
    dry = compress(project / "point_cloud.ply", None, max_drop=1.0, dry_run=True, **TINY)
    assert dry.output is None and dry.size == tiny[1].size and dry.quality == tiny[1].quality
    assert [path.name for path in tmp_path.iterdir()] == ["b.fgs"]


def test_size_targets_are_respected(project: Path, tmp_path: Path) -> None:
    result = compress(project / "point_cloud.ply", tmp_path / "a.fgs", max_size=15_000, **TINY)
    assert result.reached and 12_000 < result.size <= 15_000 and result.decided_by == "size"
    ratio = compress(project / "point_cloud.ply", tmp_path / "b.fgs", min_ratio=2.5, **TINY)
    assert ratio.ratio >= 2.5 and os.stat(tmp_path / "b.fgs").st_size == ratio.size
    with pytest.raises(TargetError, match=r"size <= 300 B is out of reach.*--best-effort"):
        compress(project / "point_cloud.ply", tmp_path / "c.fgs", max_size=300, **TINY)


def test_the_closest_point_is_written_when_asked(project: Path, tmp_path: Path) -> None:
    closest = compress(project / "point_cloud.ply", tmp_path / "c.fgs", max_size=300, best_effort=True, **TINY)
    assert closest.reached is False and closest.size > 300 and info(tmp_path / "c.fgs").settings["reached"] is False


def test_fidelity_and_modelled_drop_decide_without_photos(project: Path, tmp_path: Path) -> None:
    scene = project / "point_cloud.ply"
    modelled = compress(scene, tmp_path / "a.fgs", images="none", max_drop=2.0, **TINY)
    assert modelled.decided_by == "modelled drop" and modelled.reached and modelled.quality is not None
    assert modelled.quality.drop is None and modelled.quality.modelled_drop <= 2.0
    faithful = compress(scene, tmp_path / "b.fgs", images="none", min_fidelity=38.0, **TINY)
    assert faithful.decided_by == "fidelity" and faithful.reached and faithful.quality is not None
    assert faithful.quality.fidelity is not None and faithful.quality.fidelity >= 38.0
    trained = compress(scene, tmp_path / "c.fgs", select="train", max_drop=2.0, **TINY)
    assert trained.decision_views == "training" and trained.quality_views == "held-out"


def test_the_refit_pays(sample: tuple[Path, CompressResult], sample_dir: Path, tmp_path: Path) -> None:
    """A file that loses as much against the photos is smaller with it."""
    without = compress(sample_dir / "point_cloud.ply", tmp_path / "b.fgs", max_drop=1.0, refit=False, **SMALL)
    assert sample[1].size < 0.9 * without.size


@pytest.mark.parametrize(("unseen", "kept"), [("keep", 40), ("drop", 0), ("25%", 10)])
def test_gaussians_that_no_pose_sees(project: Path, tmp_path: Path, unseen: str, kept: int) -> None:
    planes = random_scene(COUNT, seed=3, degree=1).read(slice(0, COUNT), list(FIELD))
    planes = {name: np.concatenate([values, values[:, :40]], axis=1) for name, values in planes.items()}
    planes["means"][2, COUNT:] -= 5000.0  # behind all of them
    planes["log_scales"][:, COUNT:] = -3
    planes["log_scales"][:2, COUNT + 5 : COUNT + 15] = -2  # these ten would show most of all
    planes["opacity_logits"][:, COUNT:] = 2
    write_ply(tmp_path / "far.ply", MemorySource(planes, 1))
    words = {
        **TINY,
        "cameras": str(project / "cameras.json"),
        "min_fidelity": 30.0,
        "unseen": unseen,
        "promise": "mean",
    }
    compress(tmp_path / "far.ply", tmp_path / "a.fgs", **words)
    source = open_scene(tmp_path / "a.fgs")
    depth = source.read(slice(0, source.count), ["means"])["means"][2] + source.origin[2]
    assert (depth < -1000).sum() == kept
    if unseen == "25%":
        scales = source.read(slice(0, source.count), ["log_scales"])["log_scales"][:, depth < -1000]
        assert (scales.max(axis=0) > -2.5).all()


def test_dead_splats_go_first(project: Path, tmp_path: Path) -> None:
    logits = np.array([-5.6, -5.5, -5.55, 0, 9], np.float32)
    np.testing.assert_array_equal(alive(logits), [False, True, False, True, True])
    planes = random_scene(COUNT, seed=3, degree=1).read(slice(0, COUNT), list(FIELD))
    planes["opacity_logits"][:, ::2] = -9
    write_ply(tmp_path / "dead.ply", MemorySource(planes, 1))
    words = {**TINY, "cameras": str(project / "cameras.json"), "min_fidelity": 45.0}
    assert compress(tmp_path / "dead.ply", tmp_path / "a.fgs", **words).count <= COUNT // 2


def test_scenes_without_sh(tmp_path: Path) -> None:
    folder = make_project(tmp_path / "plain", photos=False, degree=0)
    result = compress(folder / "point_cloud.ply", tmp_path / "a.fgs", min_fidelity=36.0, **TINY)
    assert result.sh_count == 0 and open_scene(tmp_path / "a.fgs").sh_degree == 0


def test_a_file_of_the_best_method_can_be_compressed_again(
    project: Path, tiny: tuple[Path, CompressResult], tmp_path: Path
) -> None:
    words = {**TINY, "cameras": str(project / "cameras.json"), "min_fidelity": 36.0}
    result = compress(tiny[0], tmp_path / "b.fgs", **words)
    assert result.scene.count == tiny[1].count and result.size < tiny[1].size


def test_one_gaussian(project: Path, tmp_path: Path) -> None:
    source = random_scene(1, seed=4, degree=1, opacity=3.0, spread=0.1)
    write_ply(tmp_path / "one.ply", source)
    words = {**TINY, "cameras": str(project / "cameras.json"), "min_fidelity": 40.0, "best_effort": True}
    result = compress(tmp_path / "one.ply", tmp_path / "a.fgs", **words)
    assert result.count == 1 and result.reached


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"prune_rate": 0.2, "sh_rate": 0.1}, "--prune-rate belongs to --method paper"),
        ({"score": "meson"}, "--score belongs to --method paper"),
        ({"score_cache": "s.npz"}, "--score-cache belongs to --method paper"),
        ({"bits": "rtn8"}, "--bits belongs to --method paper"),
        ({"groups": 7}, "--groups belongs to --method paper, and this run is --method best: add --method paper"),
        ({"method": "paper", "unseen": "drop"}, "--unseen belongs to --method best"),
        ({"method": "paper", "refit": False}, r"--\[no-\]refit belongs to --method best"),
        ({"unseen": "hide"}, "--unseen hide: expected keep, drop, or a share"),
        ({"unseen": "120%"}, "--unseen 120%: expected"),
        ({"max_drop": 1.0, "min_ratio": 3.0}, "--max-drop and --min-ratio: give one target"),
    ],
)
def test_words_that_make_no_sense(words: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        CompressOptions(**words)


def test_layers_are_the_same_scene_and_worth_most_first(project: Path, tmp_path: Path) -> None:
    words = {**TINY, "cameras": str(project / "cameras.json"), "min_fidelity": 40.0}
    plain = compress(project / "point_cloud.ply", tmp_path / "plain.fgs", **words)
    layered = compress(project / "point_cloud.ply", tmp_path / "layered.fgs", layers=3, **words)
    assert plain.quality is not None and layered.quality is not None
    assert plain.count == layered.count and abs(plain.quality.fidelity - layered.quality.fidelity) < 1e-3  # type: ignore[operator]
    rows = [layer["rows"] for layer in info(tmp_path / "layered.fgs").layers]
    assert len(rows) == 3 and all(rows)
    trim(tmp_path / "layered.fgs", tmp_path / "half.fgs", layered.size - 1)
    half = open_scene(tmp_path / "half.fgs")
    assert half.count == sum(rows[:2])
    # The first layers against as many rows from the file's other end: what matters comes first.
    whole = open_scene(tmp_path / "layered.fgs")
    views: dict[str, Any] = {"cameras": words["cameras"], "images": "none"}
    write_ply(tmp_path / "rest.ply", whole.select(np.arange(whole.count - half.count, whole.count)))
    best, rest = (
        evaluate(tmp_path / name, tmp_path / "layered.fgs", **views).quality for name in ("half.fgs", "rest.ply")
    )
    assert best.fidelity > rest.fidelity + 3  # type: ignore[operator]
    with pytest.raises(InputError, match="--layers 5"):
        CompressOptions(method="best", layers=5)
    with pytest.raises(InputError, match="--layers belongs to --method best"):
        CompressOptions(method="paper", layers=2)


@pytest.mark.parametrize(
    ("least", "most", "limit", "there"),
    [(10**9, 10**9, 0, False), (0, 10**9, 0, True), (0, 10**9, 1, True), (0, 9, 0, False)],
)
def test_large_files_have_a_preview_for_which_a_size_leaves_room(
    tiny: tuple[Path, CompressResult],
    project: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    least: int,
    most: int,
    limit: int,
    there: bool,
) -> None:
    monkeypatch.setattr("flexgs_edge.methods.best.preview.LEAST_PREVIEWED", least)
    monkeypatch.setattr("flexgs_edge.methods.best.preview.PREVIEW_SHARE", 0.4)  # of a file this small, 2 % hold nothing
    monkeypatch.setattr("flexgs_edge.methods.best.layers.MOST_SORTED", most)
    monkeypatch.setattr("flexgs_edge.methods.best.layers.SORTED_ROW_BYTES", 10**3)
    # Without a preview, the file would fit by a few bytes.
    target = {"max_size": tiny[1].size + 20} if limit else {"max_drop": 1.0}
    result = compress(
        tiny[0] if limit else project / "point_cloud.ply",
        tmp_path / "a.fgs",
        **{**TINY, **target, "cameras": str(project / "cameras.json"), "images": str(project / "images")},
    )
    preview = info(tmp_path / "a.fgs").preview
    assert (preview is not None) is there and (not limit or result.size <= tiny[1].size + 20)
    if preview is not None:
        assert 0 < preview["rows"] < result.count and preview["bytes"] <= 0.4 * result.size


def test_a_preview_that_is_asked_for(project: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """It stays in its bytes, and a size target counts it; what is behind it is the file without one."""
    words = {**TINY, "cameras": str(project / "cameras.json"), "min_fidelity": 40.0}
    plain = compress(project / "point_cloud.ply", tmp_path / "plain.fgs", **words)
    result = compress(project / "point_cloud.ply", tmp_path / "a.fgs", preview=2500, **words)
    found = info(tmp_path / "a.fgs")
    assert found.preview is not None and 1000 < found.preview["bytes"] <= 2500
    assert found.overhead_bytes < info(tmp_path / "plain.fgs").overhead_bytes + 40
    assert result.size == plain.size + found.preview["bytes"] + len(',"preview_bytes":1234')
    assert (
        result.preview_bytes == result.to_json()["preview_bytes"] == found.preview["bytes"] and plain.preview_bytes == 0
    )
    assert "preview:" in result.summary() and "preview:" not in plain.summary()
    dry = compress(project / "point_cloud.ply", None, preview=2500, dry_run=True, **words)
    assert dry.size == result.size
    cut = trim(tmp_path / "a.fgs", tmp_path / "small.fgs", 2500)
    assert cut.is_preview and "kept  the preview" in cut.summary() and cut.count == found.preview["rows"]
    small, whole = open_scene(tmp_path / "small.fgs"), open_scene(tmp_path / "a.fgs")
    assert small.sh_degree == 0 and small.count < whole.count / 2
    drawn = ("near", "background", "extent", "antialiased")
    assert small.settings == {name: whole.settings[name] for name in drawn}
    # Beside as many rows, as large as these would have to be, it looks better.
    views: dict[str, Any] = {"cameras": words["cameras"], "images": "none"}
    rows = np.arange(0, whole.count, whole.count // small.count)[: small.count]
    write_ply(tmp_path / "rows.ply", GrownSource(whole.select(rows), whole.count))
    made, grown = (
        evaluate(tmp_path / name, tmp_path / "plain.fgs", **views).quality for name in ("small.fgs", "rows.ply")
    )
    assert made.fidelity > grown.fidelity + 3
    assert not trim(tmp_path / "a.fgs", tmp_path / "copy.fgs", result.size).is_preview

    target = {**TINY, "cameras": words["cameras"], "max_size": plain.size}
    both = compress(project / "point_cloud.ply", tmp_path / "b.fgs", preview=2500, **target)
    assert both.size <= plain.size and info(tmp_path / "b.fgs").preview is not None
    with caplog.at_level("WARNING"):
        compress(project / "point_cloud.ply", tmp_path / "c.fgs", preview=300, **words)
    assert "no preview fits into 300" in caplog.text and info(tmp_path / "c.fgs").preview is None
    with pytest.raises(InputError, match="--preview -1: expected 0"):
        CompressOptions(preview=-1)
    with pytest.raises(InputError, match="--preview belongs to --method best"):
        CompressOptions(method="paper", preview=5000)
    with pytest.raises(InputError, match=r"--preview 5000: \.spz has no preview"):
        compress(project / "point_cloud.ply", tmp_path / "a.spz", preview=5000, **words)


def test_rows_are_sorted_where_their_lists_fit() -> None:
    """Three fifths of a large scene fit into what its search had for lists of rows; a small scene always does."""
    assert can_sort(1 << 18, 1 << 18) and can_sort(1_170_000, 2_000_000)
    assert not can_sort(1_200_000, 2_000_000)


def test_cameras_are_needed(project: Path, tmp_path: Path) -> None:
    shutil.copy(project / "point_cloud.ply", tmp_path / "lonely.ply")
    with pytest.raises(InputError, match=r"--cameras none leaves no views.*what each Gaussian is worth"):
        compress(tmp_path / "lonely.ply", tmp_path / "a.fgs", cameras="none", **TINY)
    with pytest.raises(InputError, match="all of them held out"):
        compress(project / "point_cloud.ply", tmp_path / "a.fgs", cameras=one_camera(project, tmp_path), **TINY)
    assert not (tmp_path / "a.fgs").exists()


def one_camera(project: Path, folder: Path) -> str:
    entries = json.loads((project / "cameras.json").read_text())
    (folder / "one.json").write_text(json.dumps(entries[:1]))
    return str(folder / "one.json")


def test_nothing_is_left_behind(project: Path, tmp_path: Path) -> None:
    (tmp_path / "a.fgs").write_text("earlier")
    with pytest.raises(BudgetError, match=r"use --memory-limit \d+MiB or more"):
        compress(project / "point_cloud.ply", tmp_path / "b.fgs", memory_limit=2**20, **TINY)

    # Where training poses decide, the views that report have not seen the file.
    words = {**TINY, "force": True, "min_fidelity": 30.0, "select": "train", "progress": Stopped(enabled=False)}
    with pytest.raises(KeyboardInterrupt):
        compress(project / "point_cloud.ply", tmp_path / "a.fgs", **words)
    assert [path.name for path in tmp_path.iterdir()] == ["a.fgs"]
    assert (tmp_path / "a.fgs").read_text() == "earlier"


def test_bits_of_a_grid_add_up_to_its_size() -> None:
    grid = make_grid(700, 3)
    encoded = encode_grid(grid)
    bits = bit_model(grid, encoded)
    rows = [np.count_nonzero(grid.sh_degrees >= degree) for degree in (1, 2, 3)]
    total = bits.base * 700 + sum(band * count for band, count in zip(bits.bands, rows, strict=True))
    coded = len(encoded.model.to_bytes()) + sum(map(len, encoded.streams()))
    assert total == pytest.approx(8 * encoded.information, rel=1e-9) and 0.95 * coded < encoded.information < coded
    plain = encode_grid(make_grid(50, 0))
    bits = bit_model(make_grid(50, 0), plain)
    assert bits.bands == () and bits.base * 50 == pytest.approx(8 * plain.information)
    nothing = make_grid(0, 0)
    assert bit_model(nothing, encode_grid(nothing)).bands == () and from_grid(nothing)["means"].shape == (3, 0)


def test_gaussians_too_far_away_for_the_grid_are_left_out_and_counted(
    project: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    source = open_scene(project / "point_cloud.ply")
    planes = source.read(slice(0, COUNT), list(FIELD))
    far = {name: np.concatenate([values, values[:, :2]], axis=1) for name, values in planes.items()}
    far["means"][:, -2:] = np.array([[0.0, 1e7], [0.0, 1e7], [-1e7, -1e7]])
    write_ply(tmp_path / "far.ply", MemorySource(far))
    words = {**TINY, "max_drop": 1.0, "dry_run": True, "cameras": str(project / "cameras.json")}
    with caplog.at_level("WARNING", "flexgs_edge"):
        found = compress(tmp_path / "far.ply", None, images=str(project / "images"), **words)
    assert "2 Gaussians that no scored pose sees were left out" in caplog.text
    assert found.reached and found.steps is not None and float(found.steps["position"]) < 0.1
