"""Streamed SOG as we write it: each level is the scene up to a layer, for our reader and for PlayCanvas's programs."""

from __future__ import annotations

import json
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexgs_edge.codec.v2.container import write_grid
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.commands.decompress import decompress
from flexgs_edge.errors import InputError
from flexgs_edge.grid.to_grid import to_grid
from flexgs_edge.io import streamed_sog_writer
from flexgs_edge.io.exchange import read_foreign
from flexgs_edge.io.frames import Frame
from flexgs_edge.io.ply import PlySource, write_ply
from flexgs_edge.io.reading import Reading
from flexgs_edge.scene.source import SceneSource
from grid_scenes import STEPS, make_planes
from scene_files import open_scene
from synthetic import random_scene

ROWS = 400
PROGRAM = Path("@playcanvas") / "splat-transform" / "bin" / "cli.mjs"
OCTREE = Path("playcanvas/build/playcanvas/src/scene/gsplat-unified/gsplat-octree.js")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three layers, the second of which is empty."""
    layer, degrees = np.repeat([0, 2], [150, 250]), np.arange(ROWS) % 3
    grid = to_grid(make_planes(ROWS, 2, 0), degrees, STEPS, (5.0, -2.0, 0.0), layer)[0]
    place = tmp_path_factory.mktemp("scene") / "scene.fgs"
    write_grid(place, grid, {"antialiased": True})
    return place


def means(source: SceneSource, rows: slice) -> np.ndarray:
    """Positions in the world, sorted."""
    found = source.read(rows, ["means"])["means"].astype(np.float64) + source.origin[:, None]
    return found[:, np.lexsort(np.round(found, 3))]


def level(folder: Path, number: int) -> SceneSource:
    return read_foreign(folder / "lod-meta.json", Reading(lod=number))


def leaves(node: dict[str, Any]) -> list[dict[str, Any]]:
    return [node] if "lods" in node else [leaf for child in node["children"] for leaf in leaves(child)]


@pytest.mark.parametrize("leaf_rows", [1 << 19, 90], ids=["one part", "many parts"])
def test_levels_are_the_scene_up_to_a_layer(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, leaf_rows: int
) -> None:
    monkeypatch.setattr(streamed_sog_writer, "LEAF_ROWS", leaf_rows)
    result = decompress(scene, tmp_path / "out" / "lod-meta.json")
    files = [path for path in (tmp_path / "out").rglob("*") if path.is_file()]
    assert result.size == sum(path.stat().st_size for path in files)
    meta = json.loads((tmp_path / "out" / "lod-meta.json").read_text())
    assert (meta["lodLevels"], meta["counts"], meta["count"]) == (2, [ROWS, 150], ROWS + 150)
    told = read_foreign(tmp_path / "out" / "lod-meta.json").notes
    assert told == ("level of detail 0 of 2, the finest that is there; coarser ones: --lod 1",)
    found = leaves(meta["tree"])
    assert len(found) == (1 if leaf_rows > ROWS else 8)
    source = open_scene(scene)
    tolerance = np.abs(means(source, slice(0, ROWS))).max() / 2000
    for number, count in enumerate(meta["counts"]):
        one = level(tmp_path / "out", number)
        assert (one.count, one.sh_degree, one.settings) == (count, 2, {"antialiased": True})
        np.testing.assert_allclose(means(one, slice(0, count)), means(source, slice(0, count)), atol=tolerance)
        # Coarse levels are larger, by what their own part of the tree lacks.
        grown = [
            np.median(values.read(slice(0, count), ["log_scales"])["log_scales"].astype(np.float64))
            for values in (one, source)
        ]
        lacks = [leaf["lods"]["0"]["count"] / leaf["lods"]["1"]["count"] for leaf in found]
        expected = np.log([min(lacks), max(lacks)] if number else [1.0, 1.0]) / 8
        assert expected[0] - 0.02 < grown[0] - grown[1] < expected[1] + 0.02
    assert len(set(meta["filenames"])) == len(meta["filenames"])


def test_parts_lie_in_their_boxes(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streamed_sog_writer, "LEAF_ROWS", 200)
    decompress(scene, tmp_path / "out" / "lod-meta.json")
    tree = json.loads((tmp_path / "out" / "lod-meta.json").read_text())["tree"]
    found = leaves(tree)
    wide = level(tmp_path / "out", 0)
    at = 0
    for leaf in found:
        count = leaf["lods"]["0"]["count"]
        planes = wide.read(slice(at, at + count), ["means", "log_scales"])
        low, high = (np.array(leaf["bound"][end])[:, None] for end in ("min", "max"))
        assert (planes["means"] > low).all() and (planes["means"] < high).all()
        # Three standard deviations along the axes of the world are at least those of the shortest axis.
        least = 3 * np.exp(planes["log_scales"].min(axis=0)) * 0.9
        assert (planes["means"] - least > low).all() and (planes["means"] + least < high).all()
        at += count
    assert at == ROWS
    for end, pick in (("min", np.min), ("max", np.max)):
        assert tree["bound"][end] == pytest.approx(pick([leaf["bound"][end] for leaf in found], axis=0))


def test_a_preview_is_the_coarsest_level(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its Gaussians are in the part of the tree where they lie, and as large as they are."""
    monkeypatch.setattr(streamed_sog_writer, "LEAF_ROWS", 200)
    planes = {name: np.ascontiguousarray(values[..., ::7]) for name, values in make_planes(ROWS, 2, 0).items()}
    rows = np.zeros(planes["means"].shape[1], np.uint8)
    small = to_grid({**planes, "sh_rest": planes["sh_rest"][:0]}, rows, replace(STEPS, sh=()), (5.0, -2.0, 0.0))[0]
    write_grid(tmp_path / "small.fgs", small, {})
    write_grid(tmp_path / "both.fgs", GridSource(scene).grid(), {}, preview=(tmp_path / "small.fgs").read_bytes())
    decompress(tmp_path / "both.fgs", tmp_path / "out" / "lod-meta.json")
    meta = json.loads((tmp_path / "out" / "lod-meta.json").read_text())
    assert (meta["lodLevels"], meta["counts"]) == (3, [ROWS, 150, len(rows)])
    found = [leaf for leaf in leaves(meta["tree"]) if "2" in leaf["lods"]]
    assert sum(leaf["lods"]["2"]["count"] for leaf in found) == len(rows) and len(found) > 1
    last, whole, at = level(tmp_path / "out", 2), open_scene(tmp_path / "small.fgs"), 0
    for leaf in found:
        count = leaf["lods"]["2"]["count"]
        here = means(last, slice(at, at + count))
        low, high = (np.array(leaf["bound"][end])[:, None] for end in ("min", "max"))
        assert (here > low).all() and (here < high).all()
        at += count
    every = slice(0, len(rows))
    tolerance = np.abs(means(whole, every)).max() / 2000
    np.testing.assert_allclose(np.sort(means(last, every)), np.sort(means(whole, every)), atol=tolerance)
    # The format may exchange a Gaussian's axes.
    scales = [np.sort(source.read(every, ["log_scales"])["log_scales"], axis=None) for source in (last, whole)]
    np.testing.assert_allclose(*scales, atol=0.05)
    decompress(tmp_path / "both.fgs", tmp_path / "turned" / "lod-meta.json", reading=Reading(frame=Frame("RUB")))
    assert json.loads((tmp_path / "turned" / "lod-meta.json").read_text())["lodLevels"] == 2


def test_a_scene_without_layers_has_one_level(tmp_path: Path) -> None:
    write_ply(tmp_path / "scene.ply", random_scene(50, seed=2, degree=1))
    (tmp_path / "out").mkdir()
    decompress(tmp_path / "scene.ply", tmp_path / "out" / "lod-meta.json")
    assert open_scene(tmp_path / "out").count == 50
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["0_0", "lod-meta.json"]
    with pytest.raises(InputError, match="the folder is not empty"):
        decompress(tmp_path / "scene.ply", tmp_path / "out" / "lod-meta.json")
    decompress(tmp_path / "scene.ply", tmp_path / "out" / "lod-meta.json", force=True)
    with pytest.raises(InputError, match=r"ends in \.ply, .*lod-meta\.json"):
        decompress(tmp_path / "scene.ply", tmp_path / "out" / "lod.json")


def test_playcanvas_reads_it(node_modules: Path, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its engine takes the tree, splat-transform the pictures of each part."""
    monkeypatch.setattr(streamed_sog_writer, "LEAF_ROWS", 200)
    decompress(scene, tmp_path / "out" / "lod-meta.json")
    meta = json.loads((tmp_path / "out" / "lod-meta.json").read_text())
    script = """
        import { readFileSync } from 'node:fs';
        const [module, file] = process.argv.slice(1);
        const { GSplatOctree } = await import(module);
        const made = new GSplatOctree('http://host/out/lod-meta.json', JSON.parse(readFileSync(file)));
        const lods = made.nodes.map((node) => node.lods.map(({ file, count }) => [file, count]));
        console.log(JSON.stringify([made.lodLevels, made.files.map((file) => file.lodLevel), lods]));
    """
    if not (node_modules / OCTREE).is_file():
        pytest.skip(f"no {OCTREE} there: npm install playcanvas")
    run = subprocess.run(
        ["node", "--input-type=module", "-e", script, str(node_modules / OCTREE), str(tmp_path / "out" / "lod-meta.json")],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    levels, of_files, lods = json.loads(run.stdout)
    assert levels == 2 and of_files == [int(name[0]) for name in meta["filenames"]]
    wanted = [
        [[f"http://host/out/{meta['filenames'][lod['file']]}", lod["count"]] for lod in leaf["lods"].values()]
        for leaf in leaves(meta["tree"])
    ]
    assert lods == wanted and len(wanted) == 2
    for leaf in leaves(meta["tree"]):
        for lod in leaf["lods"].values():
            theirs = tmp_path / "theirs.ply"
            subprocess.run(
                ["node", str(node_modules / PROGRAM), "-q", "-w", "-g", "cpu",
                 str(tmp_path / "out" / meta["filenames"][lod["file"]]), str(theirs)],
                capture_output=True, text=True, check=True,
            )  # fmt: skip
            source = PlySource(theirs)
            assert source.count == lod["count"]
            low, high = (np.array(leaf["bound"][end])[:, None] for end in ("min", "max"))
            found = source.read(slice(0, source.count), ["means"])["means"] + source.origin[:, None]
            assert (found > low).all() and (found < high).all()
