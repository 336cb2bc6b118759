"""The viewer in Firefox: a second browser, with other code for WebGL2, workers and streams."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from firefox import Firefox, find_firefox, find_screen
from flexgs_edge.commands.view import view
from viewer_tab import LOOK, POSES, Drawn, decibels, picture, served, until

READY = "globalThis.viewer && viewer.stats.wholeMs > 0 && viewer.stats.firstMs > 0"


@pytest.fixture(scope="module")
def firefox(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Firefox]:
    program, screen = find_firefox(), find_screen()
    if program is None or screen is None:
        pytest.skip(f"no {'Firefox' if program is None else 'Xvfb'}: Firefox draws with WebGL2 on a screen only")
    with Firefox(program, screen, tmp_path_factory.mktemp("profile")) as made:
        if not made.run("Boolean(document.createElement('canvas').getContext('webgl2'))"):
            pytest.skip("this Firefox has no WebGL2, not even in software")
        yield made


def go(tab: Firefox, address: str) -> None:
    """Load the page and wait for the whole scene."""
    tab.open(address)
    until(tab, READY)


# Firefox draws with Mesa's llvmpipe here, which cuts what it stores where others round: Chromium's pictures are the same on it.
@pytest.mark.parametrize(("bits", "least"), [(16, 46), (8, 39)], ids=["half", "bytes"])
def test_pictures_are_those_of_render(
    firefox: Firefox, scene: Path, sample_dir: Path, drawn: Drawn, bits: int, least: float
) -> None:
    with served(scene, str(sample_dir / "cameras.json"), **LOOK) as address:
        go(firefox, f"{address}?bits={bits}")
        assert firefox.run("viewer.renderer.half") is (bits == 16)
        for pose, file in zip(POSES, drawn(False), strict=True):
            wanted = np.asarray(Image.open(file), np.float64)
            assert decibels(picture(firefox, pose, wanted.shape[1], wanted.shape[0]), wanted) >= least, pose


def pointer(kind: str, *steps: dict[str, Any]) -> dict[str, Any]:
    return {"type": "pointer", "id": kind, "parameters": {"pointerType": kind}, "actions": list(steps)}


def test_mouse_wheel_touch_and_keys(firefox: Firefox, scene: Path, sample_dir: Path) -> None:
    def eye() -> list[float]:
        found: list[float] = firefox.run("[...viewer.camera.eye, ...viewer.camera.axes.flat()]")
        return found

    def move(x: int, y: int) -> dict[str, Any]:
        return {"type": "pointerMove", "x": x, "y": y, "duration": 50}

    down, up = {"type": "pointerDown", "button": 0}, {"type": "pointerUp", "button": 0}
    with served(scene, str(sample_dir / "cameras.json")) as address:
        go(firefox, address)
        start, distance = eye(), firefox.run("viewer.camera.distance")
        firefox.act(pointer("mouse", move(200, 200), down, move(230, 210), move(260, 220), up))
        assert eye() != start and firefox.run("viewer.camera.distance") == pytest.approx(distance)
        scroll = {"type": "scroll", "x": 200, "y": 200, "deltaX": 0, "deltaY": -200}
        firefox.act({"type": "wheel", "id": "wheel", "actions": [scroll]})
        until(firefox, f"viewer.camera.distance < {distance} * 0.9")
        before = eye()
        firefox.act(pointer("touch", move(200, 200), down, move(230, 220), move(250, 240), up))
        assert eye() != before
        firefox.run("document.getElementById('canvas').focus()")
        before = eye()
        keys = [{"type": "keyDown", "value": "w"}, {"type": "pause", "duration": 1500}, {"type": "keyUp", "value": "w"}]
        firefox.act({"type": "key", "id": "keys", "actions": keys})
        until(firefox, f"viewer.camera.eye.join() !== '{','.join(map(str, before[:3]))}'")
        firefox.act(
            {"type": "key", "id": "keys", "actions": [{"type": kind, "value": "r"} for kind in ("keyDown", "keyUp")]}
        )
        until(firefox, "!viewer.controls.active")
        assert eye() == pytest.approx(start)


def test_a_page_of_one_file_opens_from_disk(firefox: Firefox, scene: Path, sample_dir: Path, tmp_path: Path) -> None:
    page = tmp_path / "scene.html"
    view(scene, page, cameras=str(sample_dir / "cameras.json"))
    go(firefox, page.as_uri())
    assert firefox.run("viewer.rows") == firefox.run("viewer.header.count") > 5000
    assert picture(firefox, 0, 120, 90).std() > 10


def test_a_damaged_file_is_no_scene(firefox: Firefox, scene: Path, sample_dir: Path, tmp_path: Path) -> None:
    data = bytearray(scene.read_bytes())
    data[-3000] ^= 1
    with served(scene, str(sample_dir / "cameras.json")) as address:
        good = scene.read_bytes()
        scene.write_bytes(data)
        try:
            firefox.open(address)
            until(firefox, "document.querySelector('#status.error')")
            text = firefox.run("document.getElementById('status').textContent")
        finally:
            scene.write_bytes(good)
    assert "checksum: wanted" in text and "the file is damaged" in text
