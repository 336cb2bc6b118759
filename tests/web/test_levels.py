"""Levels in the viewer, in headless Chromium: each chunk is drawn once, by the version that a budget allows."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from browser import Browser
from flexgs_edge.codec.v2.container import GridContainer
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.commands.render import render_views
from flexgs_edge.commands.view import view
from flexgs_edge.io.ply import write_ply
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource
from grid_scenes import levelled
from viewer_tab import LOOK, POSES, Drawn, decibels, faults, go, picture, served, site, until

CHUNK_ROWS, SIZE = 512, (480, 360)  # of the sample's pictures
NOW = "viewer.spacePreview.chunks.map(({ now, there }) => [now, there.length])"


@pytest.fixture(scope="module")
def files(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    return levelled(scene, tmp_path_factory.mktemp("levels"), CHUNK_ROWS)


def mixed(files: Sequence[Path], versions: Sequence[int], place: Path) -> None:
    """A PLY of the version of each chunk: 0 the coarsest."""
    names, parts = list(FIELD), []
    sources = [GridSource(file) for file in reversed(files)]
    for chunk, version in enumerate(versions):
        header = GridContainer(files[-1 - version]).header
        own = next(each for each in header.chunks() if version == 2 or each.layer == chunk)
        rows = slice(CHUNK_ROWS * chunk, min(CHUNK_ROWS * (chunk + 1), header.count)) if version == 2 else own
        parts.append(sources[version].read(slice(rows.start, rows.stop), names))
        parts[-1]["sh_rest"] = np.resize(
            parts[-1]["sh_rest"] if version == 2 else 0, (sources[2].width("sh_rest"), rows.stop - rows.start)
        ).astype(np.float32)
    planes = {name: np.concatenate([part[name] for part in parts], axis=-1) for name in names}
    write_ply(place, MemorySource(planes, origin=sources[2].origin))


def test_with_room_for_all_the_finest_is_drawn(
    tab: Browser, files: tuple[Path, Path, Path], sample_dir: Path, drawn: Drawn
) -> None:
    with served(files[0], str(sample_dir / "cameras.json"), **LOOK) as address:
        go(tab, address)
        assert tab.run("viewer.rows") == GridContainer(files[0]).header.count
        for pose, file in zip(POSES, drawn(False), strict=True):
            wanted = np.asarray(Image.open(file), np.float64)
            assert decibels(picture(tab, pose, wanted.shape[1], wanted.shape[0]), wanted) >= 50
    assert faults(tab) == []


def draws(tab: Browser, most: float) -> None:
    """Let the page draw so many splats, as on a slow device, in pictures too."""
    fixed = f"{{ get: () => {most}, set() {{}} }}"
    tab.run(
        f"(() => {{ Object.defineProperties(viewer.pace, {{ moving: {fixed}, still: {fixed} }});"
        "Object.defineProperty(viewer, 'taking', { get: () => false, set() {} }); })()"
    )


@pytest.mark.parametrize("share", [0.15, 0.5])
def test_under_a_budget_each_chunk_is_drawn_once(
    tab: Browser, files: tuple[Path, Path, Path], sample_dir: Path, tmp_path: Path, share: float
) -> None:
    """`share`: of the splats that are drawn at most."""
    cameras, count = str(sample_dir / "cameras.json"), GridContainer(files[0]).header.count
    with served(files[0], cameras, **LOOK) as address:
        go(tab, address)
        draws(tab, share * count)
        got = picture(tab, POSES[0], *SIZE)
        versions = [now for now, there in json.loads(tab.run(f"JSON.stringify({NOW})"))]
        assert tab.run("viewer.renderer.drawn") <= tab.run("viewer.rows") <= share * count
        assert len(set(versions)) > 1
        mixed(files, versions, tmp_path / "mixed.ply")
        (file,) = render_views(tmp_path / "mixed.ply", tmp_path, views=[POSES[0]], cameras=cameras, **LOOK).files
        assert decibels(got, np.asarray(Image.open(file), np.float64)) >= 45
    assert faults(tab) == []


def test_a_small_device_holds_some_chunks_and_the_level_of_the_others(
    tab: Browser, files: tuple[Path, Path, Path], sample_dir: Path
) -> None:
    header = GridContainer(files[0]).header
    budget = 3 * header.count // 5
    with served(files[0], str(sample_dir / "cameras.json"), **LOOK) as address:
        go(tab, f"{address}?splats={budget}")
        held = "viewer.space.parts.filter((part) => part.here).length"
        until(tab, "viewer.asking === 0")
        assert tab.run(held) == (budget - GridContainer(files[1]).header.count) // CHUNK_ROWS
        assert tab.run(f"JSON.stringify({NOW}.every(([now, there]) => there >= 2 && now === there - 1))") == "true"
        assert tab.run("viewer.rows") < budget
    assert faults(tab) == []


def test_a_server_without_ranges_sends_the_preview_first(
    tab: Browser, files: tuple[Path, Path, Path], sample_dir: Path, tmp_path: Path
) -> None:
    view(files[0], tmp_path / "site")
    with site(tmp_path / "site") as address:
        go(tab, f"{address}/index.html")
        assert tab.run("viewer.rows") == GridContainer(files[0]).header.count
    assert faults(tab) == []
