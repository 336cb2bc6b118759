"""What jobs refuse on a tiny scene, and what they leave behind then: nothing."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexgs_edge.commands.compress import compress
from flexgs_edge.commands.decompress import decompress
from flexgs_edge.commands.info import info
from flexgs_edge.errors import BudgetError, InputError, TargetError
from flexgs_edge.io.ply import write_ply
from flexgs_edge.report.results import CompressResult
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource
from scene_files import open_scene
from stopped import Stopped
from tiny_project import COUNT, FAST, compress_project, make_project, write_cameras


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_project(tmp_path_factory.mktemp("tiny") / "scene")


@pytest.fixture(scope="module")
def done(project: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, CompressResult]:
    folder = tmp_path_factory.mktemp("done")
    return folder, compress_project(project, folder)


def test_no_cameras_at_all(tmp_path: Path, done: tuple[Path, CompressResult], project: Path) -> None:
    lonely = tmp_path / "scene.ply"
    lonely.write_bytes((project / "point_cloud.ply").read_bytes())
    none: dict[str, Any] = {**FAST, "cameras": "none"}
    with pytest.raises(InputError, match=r"--cameras none leaves no views.*only --prune-rate 0"):
        compress(lonely, tmp_path / "a.fgs", **none)
    with pytest.raises(InputError, match="no views"):
        compress(lonely, tmp_path / "a.fgs", prune_rate=0.2, sh_rate=0.2, **none)
    with pytest.raises(InputError, match="photos need the cameras"):
        compress(lonely, tmp_path / "a.fgs", images=str(project / "images"), **FAST)
    whole = compress(lonely, tmp_path / "a.fgs", prune_rate=0, sh_rate=0, method="paper", cameras="none")
    assert whole.count == COUNT and whole.quality is None and whole.run.device is None
    assert whole.size == os.stat(tmp_path / "a.fgs").st_size and "none" in whole.summary()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"max_drop": 1.0, "max_size": 10}, "--max-drop and --max-size: give one target"),
        ({"prune_rate": 0.2}, "--prune-rate and --sh-rate: give both"),
        ({"prune_rate": 0.2, "sh_rate": 0.1, "min_ratio": 3.0}, "fixed rates leave nothing to search"),
        ({"prune_rate": 0.8, "sh_rate": 0.3}, "add up to at most 1"),
        ({"prune_rate": 1.0, "sh_rate": 0.0}, "nothing would be left"),
        ({"max_drop": 0.0}, "--max-drop 0"),
        ({"method": "magic"}, "--method 'magic'"),
        ({"effort": "lots"}, "--effort 'lots'"),
        ({"bits": "rtnx"}, "--bits rtnx"),
        ({"bits": "xyz=99"}, "bits of xyz"),
        ({"groups": 0}, "--groups 0"),
        ({"max_gaussians": 0}, "--max-gaussians 0"),
        ({"base_psnr": -3.0}, "--base-psnr -3"),
        ({"near": -1.0}, "--near -1"),
        ({"background": (0.0, 2.0, 0.0)}, "--background"),
        ({"up": (0.0, 0.0, 0.0)}, "--up .*: expected three finite numbers, not all zero"),
        ({"up": (0.0, float("nan"), 1.0)}, "--up"),
        ({"up": (0.0, 1.0)}, "up=.*expected three numbers"),
        ({"holdout": 1}, "--holdout 1"),
        ({"resolution": 0}, "--resolution 0"),
    ],
)
def test_options_that_make_no_sense(words: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        CompressOptions(**{"method": "paper", **words})


def test_outputs_are_checked_before_any_work(project: Path, tmp_path: Path) -> None:
    (tmp_path / "old.fgs").write_text("precious")
    missing = tmp_path / "none.ply"  # would fail later: the scene does not exist
    for output, message in (
        (tmp_path / "old.fgs", "exists"),
        (None, "-o OUT.fgs is missing"),
        ("a.ply", "ends in .fgs"),
    ):
        with pytest.raises(InputError, match=message):
            compress(missing, output)
    with pytest.raises(InputError, match=r"ends in \.ply"):
        decompress(missing, tmp_path / "a.fgs")
    assert (tmp_path / "old.fgs").read_text() == "precious"


def test_an_interrupted_run_leaves_nothing(project: Path, tmp_path: Path) -> None:
    (tmp_path / "a.fgs").write_text("earlier")
    words = {"prune_rate": 0.1, "sh_rate": 0.1, "force": True, "progress": Stopped(enabled=False), **FAST}
    with pytest.raises(KeyboardInterrupt):
        compress(project / "point_cloud.ply", tmp_path / "a.fgs", **words)
    assert [path.name for path in tmp_path.iterdir()] == ["a.fgs"]
    assert (tmp_path / "a.fgs").read_text() == "earlier"


def test_too_little_memory_names_the_smallest_limit(project: Path, tmp_path: Path) -> None:
    with pytest.raises(BudgetError, match=r"use --memory-limit \d+MiB or more"):
        compress(project / "point_cloud.ply", tmp_path / "a.fgs", memory_limit=2**20, **FAST)
    assert list(tmp_path.iterdir()) == []


def test_invalid_rows_are_refused_or_dropped_with_a_count(project: Path, tmp_path: Path) -> None:
    source = open_scene(project / "point_cloud.ply")
    planes = {name: source.read(slice(0, COUNT), [name])[name].copy() for name in FIELD}
    planes["opacity_logits"][0, 5:8] = np.nan
    write_ply(tmp_path / "bad.ply", MemorySource(planes, 1))
    write_cameras(tmp_path / "cameras.json")
    words = {**FAST, "prune_rate": 0.1, "sh_rate": 0.1}
    with pytest.raises(InputError, match=r"3 of 400 Gaussians are invalid.*first row 5.*--drop-invalid"):
        compress(tmp_path / "bad.ply", tmp_path / "a.fgs", **words)
    result = compress(tmp_path / "bad.ply", tmp_path / "a.fgs", drop_invalid=True, **words)
    assert result.scene.count == COUNT - 3 and "3 of 400 Gaussians left out" in result.summary()
    assert info(tmp_path / "a.fgs").settings["source_count"] == COUNT


@pytest.mark.parametrize("method", ["best", "paper"])
def test_a_result_larger_than_its_input_is_not_written(
    tmp_path: Path, done: tuple[Path, CompressResult], project: Path, method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flexgs_edge.run.run.LEAST_REFUSED", 1000)
    small = compress(project, tmp_path / "small.fgs", max_size=4000, **FAST).size
    words: dict[str, Any] = {**FAST, "method": method, "cameras": str(project / "cameras.json"), "images": "none"}
    finer = (
        {"min_fidelity": 60.0}
        if method == "best"
        else {"prune_rate": 0.0, "sh_rate": 0.0, "bits": "dc=16,scale=16,rot=16,opacity=16"}
    )
    found = rf"the result would have \d+ bytes, and the input has {small}: nothing was written\. Keep the input, or"
    with pytest.raises(TargetError, match=found):
        compress(tmp_path / "small.fgs", tmp_path / "larger.fgs", **words, **finer)
    assert [file.name for file in tmp_path.iterdir()] == ["small.fgs"]
    larger = compress(tmp_path / "small.fgs", tmp_path / "larger.fgs", best_effort=True, **words, **finer)
    assert larger.size > small and "keep the input" in larger.warnings[-1]
