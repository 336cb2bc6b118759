"""The box of the served page: dragged, moved by keys, shown, and in the command line that keeps what is inside."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from browser import Browser
from flexgs_edge.codec.open_fgs import open_fgs
from flexgs_edge.commands.view import view
from flexgs_edge.io.reading import parse_crop
from flexgs_edge.scene.crop import GEOMETRY
from viewer_tab import drag, faults, go, picture, requests, served, until

SLIDERS = "[...document.querySelectorAll('[role=slider]')]"
NAME = "it's a scene.fgs"


def box(tab: Browser) -> list[float]:
    words = shlex.split(tab.run("document.getElementById('command').value"))
    return [float(value) for value in words[-1].removeprefix("--crop=").split(",")]


def middle(tab: Browser, face: int) -> tuple[float, float]:
    x, y = tab.run(f"(b => [b.x + b.width / 2, b.y + b.height / 2])({SLIDERS}[{face}].getBoundingClientRect())")
    return x, y


def test_a_box_to_drag(tab: Browser, scene: Path, sample_dir: Path, tmp_path: Path) -> None:
    place = tmp_path / NAME
    place.write_bytes(scene.read_bytes())
    with served(place, str(sample_dir / "cameras.json")) as address:
        go(tab, address, 600, 450)
        assert not any("crop.js" in str(event) for event in requests(tab)), "few want it"
        whole = picture(tab, 0, 240, 180)
        tab.run("for (const id of ['panel', 'more']) document.getElementById(id).open = true")
        until(tab, "document.getElementById('crop')")
        assert tab.run("document.getElementById('command').hidden")
        tab.run("document.getElementById('crop').click(); document.getElementById('panel').open = false")
        until(tab, f"{SLIDERS}.some((one) => one.offsetWidth)")
        assert tab.run(f"{SLIDERS}.map((one) => one.ariaLabel)") == [
            f"{axis} {end}" for axis in "xyz" for end in ("from", "to")
        ]
        words = shlex.split(tab.run("document.getElementById('command').value"))
        assert words[:-1] == ["flexgs-edge", "compress", str(place), "-o", "cropped.fgs"]
        origin = tab.run("viewer.header.origin")
        first = box(tab)
        assert first == pytest.approx(
            np.add(tab.run("[...viewer.box.low, ...viewer.box.high]"), [*origin, *origin]), abs=0.01
        )
        source = open_fgs(place)
        crop = parse_crop(words[-1].removeprefix("--crop="))
        inside = crop.inside(source.read(slice(0, source.count), GEOMETRY), source.origin)
        assert 0.3 < inside.mean() < 0.95
        # What is outside is not drawn.
        until(tab, "viewer.look.crop")
        assert np.abs(picture(tab, 0, 240, 180) - whole).mean() > 1
        # Keys move a face, and not the camera.
        eye, step = tab.run("viewer.camera.eye"), 0.01 * float(np.linalg.norm(np.subtract(first[3:], first[:3])))
        tab.run(f"{SLIDERS}[0].focus()")
        tab.press("ArrowRight", 39)
        assert box(tab) == pytest.approx([first[0] + step, *first[1:]], abs=0.01)
        assert tab.run(f"{SLIDERS}[0].ariaValueText") == f"{box(tab)[0]:g}" and tab.run("viewer.camera.eye") == eye
        # A drag moves the face under the pointer.
        tab.run("viewer.camera.zoom(3); viewer.refresh()")
        until(tab, "!viewer.wanted && !viewer.drawing")
        on_top = "document.elementFromPoint(...{}) === {}[{}]"
        face = next(face for face in (1, 3, 5) if tab.run(on_top.format([*middle(tab, face)], SLIDERS, face)))
        axis, at, before = face >> 1, middle(tab, face), box(tab)
        ahead = middle_after(tab, face)
        way = np.subtract(ahead, at)
        way *= 30 / np.linalg.norm(way)
        drag(tab, *(round(value) for value in way.tolist()), at=at)
        until(tab, "!viewer.wanted")
        after, number = box(tab), 3 * (face & 1) + axis
        assert after[number] > before[number] and [i for i in range(6) if after[i] != before[i]] == [number]
        assert np.linalg.norm(np.subtract(middle(tab, face), np.add(at, way))) < 12
        # It goes away with its hiding.
        tab.run("viewer.setPose(0)")
        tab.run("document.getElementById('crop').click()")
        until(tab, "!viewer.look.crop && !viewer.wanted")
        assert np.abs(picture(tab, 0, 240, 180) - whole).mean() < 0.5
        assert faults(tab) == []


def middle_after(tab: Browser, face: int) -> tuple[float, float]:
    """Where a handle is after a step by a key; it is moved back."""
    tab.run(f"{SLIDERS}[{face}].focus()")
    tab.press("ArrowRight", 39)
    until(tab, "!viewer.wanted")
    found = middle(tab, face)
    tab.press("ArrowLeft", 37)
    until(tab, "!viewer.wanted")
    return found


def test_pages_for_others_have_no_path(scene: Path, tmp_path: Path) -> None:
    """Nobody else has the file, and its path is none of their business."""
    view(scene, tmp_path / "page.html", cameras="none")
    view(scene, tmp_path / "site", cameras="none")
    for page in (tmp_path / "page.html", tmp_path / "site" / "index.html"):
        text = page.read_text()
        assert str(scene.parent) not in text and re.search(r'"command"', text.split("</script>")[0]) is None
