"""Notes over a scene: in a page of one file, on the hosted page, and in `<flexgs-scene>`."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from browser import Browser
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.codec.v2.container import write_grid
from flexgs_edge.commands.view import view
from grid_scenes import sample_grid
from viewer_tab import faults, go, site, until

HOSTILE = "<img src=x onerror='globalThis.ran = 1'>\u202e</script><script>globalThis.ran = 2</script>"
BUTTONS = "[...document.querySelectorAll('canvas + div button')]"
BUBBLE = "document.querySelector('canvas + div p')"
SIZE = (480, 360)


@pytest.fixture(scope="module")
def scene(sample_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("noted") / "scene.fgs"
    write_grid(place, replace(sample_grid(sample_dir, 16), origin=(0.5, -0.25, 0.125)), {})
    return place


def notes_in_view(sample_dir: Path) -> tuple[list[dict[str, Any]], list[list[float]]]:
    """Two notes that the first camera sees, one behind it; and where its picture shows the first two."""
    camera = min(read_cameras(sample_dir / "cameras.json"), key=lambda camera: camera.name)
    places = [(0.25, 0.25, 3.0), (0.7, 0.6, 2.0), (0.5, 0.5, -2.0)]
    notes, pixels = [], []
    for (across, down, depth), text in zip(places, (HOSTILE, "The second", "Behind"), strict=True):
        x, y = across * camera.width, down * camera.height
        ray = np.array([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1])
        notes.append({"at": (camera.center + camera.rotation.T @ (depth * ray)).tolist(), "text": text})
        scale = min(SIZE[0] / camera.width, SIZE[1] / camera.height)
        middle = [(SIZE[k] - scale * size) / 2 for k, size in enumerate((camera.width, camera.height))]
        pixels.append([middle[0] + scale * (x + 0.5), middle[1] + scale * (y + 0.5)])
    return notes, pixels[:2]


def centres(tab: Browser) -> list[list[float]]:
    return tab.run(
        f"{BUTTONS}.filter((one) => !one.hidden).map((one) => one.getBoundingClientRect())"
        ".map((box) => [box.x + box.width / 2, box.y + box.height / 2])"
    )


def test_they_lie_where_they_belong_and_tell_on_focus(
    tab: Browser, scene: Path, sample_dir: Path, tmp_path: Path
) -> None:
    notes, pixels = notes_in_view(sample_dir)
    (tmp_path / "notes.json").write_text(json.dumps(notes))
    view(scene, tmp_path / "page.html", cameras=str(sample_dir / "cameras.json"), notes=tmp_path / "notes.json")
    go(tab, (tmp_path / "page.html").as_uri(), *SIZE)
    until(tab, f"{BUTTONS}.length === 3")
    np.testing.assert_allclose(centres(tab), pixels, atol=1.5)
    assert tab.run(f"{BUTTONS}.map((one) => [one.textContent, one.hidden, one.offsetWidth, one.offsetHeight])") == [
        ["1", False, 44, 44],
        ["2", False, 44, 44],
        ["3", True, 0, 0],
    ]
    assert tab.run(f"{BUBBLE}.hidden")
    x, y = pixels[0]
    for kind in ("mousePressed", "mouseReleased"):
        tab.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)
    assert tab.run(f"[{BUBBLE}.hidden, {BUBBLE}.textContent, {BUBBLE}.children.length]") == [False, HOSTILE, 0]
    assert tab.run(f"{BUTTONS}[0].ariaLabel") == f"Note 1: {HOSTILE}"
    tab.press("Tab", 9)
    assert tab.run(f"[{BUBBLE}.hidden, {BUBBLE}.textContent]") == [False, "The second"]
    inside = "(({{ left, right, top, bottom }}) => left >= 0 && top >= 0 && right <= {} && bottom <= {})({})"
    assert tab.run(inside.format(*SIZE, f"{BUBBLE}.getBoundingClientRect()"))
    tab.press("Escape", 27)
    assert tab.run(f"{BUBBLE}.hidden")
    tab.run("viewer.camera.look(0.1, 0); viewer.refresh()")
    until(tab, f"!viewer.wanted && !viewer.drawing && Math.abs({BUTTONS}[0].offsetLeft + 22 - {x}) > 20")
    assert tab.run("globalThis.ran") is None and faults(tab) == []


def test_the_hosted_page_and_a_dropped_file(tab: Browser, repository: Path, scene: Path, tmp_path: Path) -> None:
    (tmp_path / "web").symlink_to(repository / "web")
    (tmp_path / "scene.fgs").write_bytes(scene.read_bytes())
    files = {
        "good.json": json.dumps([{"at": [0, 0, 0], "text": "a"}]),
        "text.json": json.dumps([{"at": [0, 0, 0], "text": "a"}, {"at": [0, 0, 0], "text": 3}]),
        "at.json": json.dumps([{"at": [0, "0", 0], "text": "a"}]),
        "none.json": "[5]",
        "object.json": "{}",
        "broken.json": "[",
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    with site(tmp_path) as address:

        def status(name: str) -> str:
            go(tab, f"{address}/web/viewer/index.html?scene=/scene.fgs&notes=/{name}", *SIZE)
            until(tab, "document.querySelector('#status.error') || document.querySelector('canvas + div')")
            return str(tab.run("document.getElementById('status').textContent"))

        assert status("good.json") == "" and tab.run(f"{BUTTONS}.length") == 1
        tab.run(
            "fetch('/scene.fgs').then((answer) => answer.blob()).then((blob) => {"
            "const data = new DataTransfer(); data.items.add(new File([blob], 'other.fgs'));"
            "document.dispatchEvent(new DragEvent('drop', { dataTransfer: data })); })"
        )
        until(tab, f"document.title.startsWith('other') && viewer.stats.wholeMs > 0 && {BUTTONS}.length === 0")
        assert "text.json: note 2: text: expected a text, found 3" in status("text.json")
        assert 'at.json: note 1: at: expected three numbers, found [0,"0",0]' in status("at.json")
        assert "none.json: note 1: at: expected three numbers, found undefined" in status("none.json")
        assert "object.json: expected a list of notes" in status("object.json")
        assert "broken.json: not JSON" in status("broken.json")
        assert "gone.json: the server says 404" in status("gone.json")


def test_an_element_has_notes(tab: Browser, scene: Path, sample_dir: Path, tmp_path: Path) -> None:
    notes, pixels = notes_in_view(sample_dir)
    (tmp_path / "some.json").write_text(json.dumps(notes))
    view(scene, tmp_path / "site", cameras=str(sample_dir / "cameras.json"), notes=tmp_path / "some.json")
    (tmp_path / "site" / "other.html").write_text(
        "<!doctype html><link rel='icon' href='data:,'><body style='margin: 0'><script src='flexgs-scene.js'></script>"
        f"<flexgs-scene src='scene.fgs' notes='notes.json' style='width: {SIZE[0]}px; height: {SIZE[1]}px'></flexgs-scene>"
        "<script>globalThis.one = document.querySelector('flexgs-scene'); one.told = [];"
        "one.addEventListener('failed', ({ detail }) => one.told.push(detail));</script>"
    )
    buttons = "[...one.shadowRoot.querySelectorAll('button')]"
    with site(tmp_path / "site") as address:
        tab.events.clear()
        tab.send("Page.navigate", url=f"{address}/other.html")
        tab.wait("Page.loadEventFired")
        until(tab, f"one.viewer.stats.wholeMs > 0 && {buttons}.length === 3")
        assert faults(tab) == []
        tab.run(
            "one.setAttribute('notes', 'gone.json'); const parent = one.parentNode; one.remove(); parent.append(one)"
        )
        until(tab, "one.told.length")
        assert tab.run("one.told") == ["gone.json: the server says 404"]
