"""Scenes that are larger than a budget of splats: no holes, whatever the file has."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from browser import Browser
from flexgs_edge.codec.open_fgs import open_fgs
from flexgs_edge.codec.v2.container import GridContainer, write_grid
from flexgs_edge.codec.v2.grid_source import GridSource
from grid_scenes import grid_of, one_layer, previewed, sample_grid
from viewer_tab import LOOK, POSES, Drawn, decibels, faults, go, picture, served, until

SMALL, LARGE = 256, 8192
"""Rows of a chunk: in many chunks, whose file tells where they lie, and in few."""
LEAST_DB = 26.0
"""Of a quarter of the splats of a scene, against all of them. Those that cover most have 22."""


def coded(scene: Path, folder: Path, chunk_rows: int, preview: bool) -> Path:
    if preview:
        return previewed(scene, folder, chunk_rows)[0]
    source, place = open_fgs(scene), folder / "still_life.fgs"
    assert isinstance(source, GridSource)
    write_grid(place, source.grid(), {}, chunk_rows=chunk_rows)
    return place


def odd_rows(scene: Path) -> int:
    """Rows of a chunk, so that the last one has a single row, of which a budget keeps none."""
    last = GridContainer(scene).header.layers[-1]
    return next(rows for rows in range(SMALL, LARGE) if last % rows == 1)


def holes(got: np.ndarray, wanted: np.ndarray) -> float:
    """The share of pixels in which the background is seen, and should not be."""
    background = 255 * np.array(LOOK["background"])
    empty, other = (np.abs(image - background).max(axis=2) for image in (got, wanted))
    return float(((empty < 8) & (other > 30)).mean())


@pytest.mark.parametrize(
    ("chunk_rows", "preview"), [(SMALL, False), (None, False), (LARGE, False), (LARGE, True), (SMALL, True)]
)
def test_a_full_budget_leaves_no_holes(
    tab: Browser, scene: Path, sample_dir: Path, drawn: Drawn, tmp_path: Path, chunk_rows: int | None, preview: bool
) -> None:
    place = coded(scene, tmp_path, chunk_rows or odd_rows(scene), preview)
    count = open_fgs(place).count
    budget = count // 3
    with served(place, str(sample_dir / "cameras.json"), **LOOK) as address:
        go(tab, f"{address}?splats={budget}")
        for pose, file in zip(POSES, drawn(False), strict=True):
            wanted = np.asarray(Image.open(file), np.float64)
            got = picture(tab, pose, wanted.shape[1], wanted.shape[0])
            assert holes(got, wanted) < 0.01
        assert 0.9 * budget < tab.run("viewer.rows") <= budget
        assert "some are shown, and larger" in tab.run("document.getElementById('status').textContent")
    assert faults(tab) == []


def test_few_splats_of_a_scene_look_like_all(tab: Browser, sample_dir: Path, tmp_path: Path) -> None:
    """Held by a device without memory for more, and drawn by one that is slow."""
    grid = sample_grid(sample_dir, 1)
    write_grid(tmp_path / "scene.fgs", grid, {})
    few, size = grid.count // 4, (160, 120)
    with served(tmp_path / "scene.fgs", str(sample_dir / "cameras.json")) as address:
        go(tab, address, *size)
        wanted = picture(tab, POSES[0], *size)
        tab.run(f"viewer.asks = {few} / viewer.rows")
        drawn = picture(tab, POSES[0], *size)
        assert 0.9 * few < tab.run("viewer.renderer.drawn") < 1.1 * few
        go(tab, f"{address}?splats={few}", *size)
        held = picture(tab, POSES[0], *size)
        assert 0.9 * few < tab.run("viewer.rows") <= few
    assert min(decibels(drawn, wanted), decibels(held, wanted)) > LEAST_DB


def test_beside_a_preview_chunks_in_sight_are_held(tab: Browser, scene: Path, sample_dir: Path, tmp_path: Path) -> None:
    """What was out of sight goes when the camera turns to what is missing."""
    write_grid(tmp_path / "one_layer.fgs", one_layer(grid_of(scene)), {})
    budget, (place, small) = 12 * SMALL, previewed(tmp_path / "one_layer.fgs", tmp_path, SMALL)
    with served(place, str(sample_dir / "cameras.json"), **LOOK) as address:
        go(tab, f"{address}?splats={budget}")
        held = "viewer.space.parts.filter((part) => part.here)"
        assert tab.run(f"{held}.length") == 12
        assert tab.run("viewer.renderer.drawn") <= budget + open_fgs(small).count
        indices = f"JSON.stringify({held}.map((part) => part.index).sort())"
        before = tab.run(indices)
        # Into the scene, and to its side.
        tab.run("(() => { viewer.camera.zoom(0.2); viewer.camera.look(2, 0); viewer.refresh(); })()")
        until(tab, f"{indices} !== {json.dumps(before)} && viewer.asking === 0")
        assert tab.run(f"{held}.length") == 12
        assert tab.run("viewer.renderer.drawn") <= budget + open_fgs(small).count
    assert faults(tab) == []
