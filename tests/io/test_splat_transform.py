"""What PlayCanvas's splat-transform reads from our files, and what we read from its files: an independent program."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest

from flexgs_edge.commands.decompress import decompress
from flexgs_edge.io.ply import PlySource, write_ply
from flexgs_edge.io.reading import Writing
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource, SceneSource
from scene_files import open_scene
from synthetic import random_scene

PROGRAM = Path("@playcanvas") / "splat-transform" / "bin" / "cli.mjs"


def transform(node_modules: Path, source: Path, target: Path, *options: str) -> None:
    """Convert a file by splat-transform."""
    program = node_modules / PROGRAM
    done = subprocess.run(
        ["node", str(program), "-q", "-w", "-g", "cpu", *options, str(source), str(target)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0 and target.is_file(), done.stderr


def values(source: SceneSource) -> dict[str, np.ndarray]:
    """Values in the order of positions, with unit quaternions of w >= 0 and opacities instead of logits."""
    found = source.read(slice(0, source.count), list(FIELD))
    order = np.lexsort(np.round(found["means"], 3))
    found = {name: plane[:, order].astype(np.float64) for name, plane in found.items()}
    found["opacity_logits"] = 1 / (1 + np.exp(-found["opacity_logits"]))
    quats = found["quats"] / np.linalg.norm(found["quats"], axis=0)
    found["quats"] = quats * np.where((quats * np.array([[1.0], [0.3], [0.2], [0.1]])).sum(axis=0) < 0, -1.0, 1.0)
    return found


def assert_alike(ours: SceneSource, theirs: SceneSource, steps: float = 1.0) -> None:
    """The same Gaussians, with room for `steps` times the rounding of a byte."""
    assert (ours.count, ours.sh_degree) == (theirs.count, theirs.sh_degree)
    bounds = {"means": 2e-3, "sh_dc": 8e-3, "sh_rest": 4e-3, "opacity_logits": 5e-3, "log_scales": 2e-3, "quats": 8e-3}
    a, b = values(ours), values(theirs)
    for name, bound in bounds.items():
        error = np.abs(a[name] - b[name]).max(initial=0.0)
        assert error <= steps * bound, f"{name}: {error}"


@pytest.fixture
def scene() -> MemorySource:
    """Positions on a grid of hundredths, so that both orders of rows are the same."""
    source = random_scene(300, seed=3, degree=3)
    planes = source.read(slice(0, 300), list(FIELD))
    cells = np.random.default_rng(0).permutation(20**3)[:300]
    planes["means"] = (np.stack(np.unravel_index(cells, (20, 20, 20))) / 4.0 - 2.5).astype(np.float32)
    planes["sh_rest"] = np.clip(planes["sh_rest"], -0.5, 0.5)
    planes["log_scales"] = np.clip(planes["log_scales"], -6, 0)
    return MemorySource(planes)


@pytest.mark.parametrize(
    "name", ["a.spz", "four.spz", "a.sog", "a.compressed.ply", "a.splat"], ids=["spz3", "spz4", "sog", "ply", "splat"]
)
def test_it_reads_what_we_write(node_modules: Path, tmp_path: Path, scene: MemorySource, name: str) -> None:
    write_ply(tmp_path / "scene.ply", scene)
    decompress(tmp_path / "scene.ply", tmp_path / name, writing=Writing(4 if name == "four.spz" else 3))
    transform(node_modules, tmp_path / name, tmp_path / "theirs.ply")
    assert_alike(open_scene(tmp_path / name), PlySource(tmp_path / "theirs.ply"))


@pytest.mark.parametrize("name", ["a.spz", "a.sog", "a.compressed.ply"])
def test_we_read_what_it_writes(node_modules: Path, tmp_path: Path, scene: MemorySource, name: str) -> None:
    write_ply(tmp_path / "scene.ply", scene)
    transform(node_modules, tmp_path / "scene.ply", tmp_path / name)
    transform(node_modules, tmp_path / name, tmp_path / "theirs.ply")
    assert_alike(open_scene(tmp_path / name), PlySource(tmp_path / "theirs.ply"))


def test_we_read_its_streamed_scenes(node_modules: Path, tmp_path: Path, scene: MemorySource) -> None:
    write_ply(tmp_path / "scene.ply", scene)
    (tmp_path / "out").mkdir()
    coarse = scene.select(np.arange(0, 300, 3))
    write_ply(tmp_path / "coarse.ply", coarse)
    done = subprocess.run(
        ["node", str(node_modules / PROGRAM), "-q", "-w", "-g", "cpu", str(tmp_path / "scene.ply"), "-l", "0",
         str(tmp_path / "coarse.ply"), "-l", "1", str(tmp_path / "out" / "lod-meta.json")],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = open_scene(tmp_path / "out")
    assert found.count == 300
    np.testing.assert_allclose(values(found)["means"], values(scene)["means"], atol=2e-3)
