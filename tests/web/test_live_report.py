"""The live scenes of a report: from disk, in a browser, under one camera."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from browser import Browser
from flexgs_edge.codec.open_fgs import read_header
from flexgs_edge.commands.compress import compress
from flexgs_edge.commands.render import render_views
from viewer_tab import decibels, drag, faults, requests, until


@pytest.fixture(scope="module")
def page(sample_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("live")
    compress(
        sample_dir / "point_cloud.ply", folder / "a.fgs", report=str(folder / "page"), method="paper", effort="fast",
        max_drop=2.0, resolution=160, holdout=20,
    )  # fmt: skip
    return folder / "page" / "index.html"


def scene_of(page: Path, name: str) -> bytes:
    found = re.search(rf'id="live-{name}">([^<]*)</script>', page.read_text())
    assert found is not None
    return base64.b64decode(found[1])


def counted(page: Path, name: str) -> int:
    place = page.parent / f"{name}.fgs"
    place.write_bytes(scene_of(page, name))
    return read_header(place).count


def picture(path: str) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB"), np.float64)


def test_the_page_holds_the_file_and_the_original(page: Path, tmp_path: Path, sample_dir: Path) -> None:
    assert scene_of(page, "compressed") == (page.parent.parent / "a.fgs").read_bytes()
    place = tmp_path / "original.fgs"
    place.write_bytes(scene_of(page, "original"))
    cameras = str(sample_dir / "cameras.json")
    drawn = [
        render_views(scene, tmp_path / name, views=[0, 27], cameras=cameras).files
        for scene, name in ((place, "coded"), (sample_dir / "point_cloud.ply", "plain"))
    ]
    for coded, plain in zip(*drawn, strict=True):
        assert decibels(picture(coded), picture(plain)) > 50


def test_both_scenes_follow_one_camera(tab: Browser, page: Path) -> None:
    tab.open(page, 500)
    assert tab.run("document.getElementById('live-stage').hidden && globalThis.liveViewers === undefined")
    tab.run("document.getElementById('live-start').click()")
    until(
        tab,
        "globalThis.liveViewers && liveViewers.every((viewer) => viewer.stats.wholeMs > 0 && viewer.stats.firstMs > 0)",
    )
    until(tab, "document.getElementById('live-status').textContent === ''")
    counts = tab.run("liveViewers.map((viewer) => viewer.rows)")
    assert counts[0] == counted(page, "original") > counts[1] == counted(page, "compressed")
    camera = "liveViewers.map(({ camera, header }) => [...camera.axes.flat(), ...camera.eye.map((x, i) => x + header.origin[i])])"
    one, two = tab.run(camera)
    assert one == pytest.approx(two, abs=1e-6)
    found = re.search(r'id="live-config">([^<]*)</script>', page.read_text())
    assert found is not None and tab.run("liveViewers[1].pose") == json.loads(found[1])["first"]
    tab.run("document.querySelector('#live canvas').scrollIntoView()")
    box = tab.run("(({ x, y }) => [x, y])(document.querySelector('#live canvas').getBoundingClientRect())")
    drag(tab, 60, 20, at=(box[0] + 100, box[1] + 80))
    until(tab, f"JSON.stringify({camera}[1]) !== {json.dumps(json.dumps(two, separators=(',', ':')))}")
    until(tab, "liveViewers.every((viewer) => !viewer.wanted && !viewer.sorting)")
    moved = tab.run(camera)
    assert moved[0] == pytest.approx(moved[1], abs=1e-6) and moved[0] != pytest.approx(one, abs=1e-3)
    pictures = tab.run("Promise.all(liveViewers.map(async (viewer) => (await viewer.picture(80, 60)).size))")
    assert min(pictures) > 1000
    assert faults(tab) == []
    assert [event["params"]["request"]["url"] for event in requests(tab)] == [page.as_uri()]
