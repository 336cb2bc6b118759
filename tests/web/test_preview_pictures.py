"""Previews in the viewer, in headless Chromium: what is drawn while a file comes is what `render` draws of the same parts."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from browser import Browser
from flexgs_edge.codec.v2.container import GridContainer, write_grid
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.commands.render import render_views
from flexgs_edge.io.ply import write_ply
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource
from flexgs_edge.viewer import server
from grid_scenes import previewed, sample_grid
from viewer_tab import LOOK, POSES, Drawn, decibels, faults, picture, served, until


@pytest.fixture(scope="module")
def scene(sample_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The whole sample: less would come with the first ranges that the viewer asks for."""
    place = tmp_path_factory.mktemp("scene") / "still_life.fgs"
    write_grid(place, sample_grid(sample_dir, 1), {}, chunk_rows=8192)
    return place


def stops_at(monkeypatch: pytest.MonkeyPatch, most: int) -> threading.Event:
    """The server sends so many bytes; the others when the event is set."""
    goes_on, write, sent = threading.Event(), server._Handler._write, []

    def waiting(self: Any, data: bytes) -> None:
        sent.append(len(data))
        if sum(sent) > most:
            assert goes_on.wait(60)
        write(self, data)

    monkeypatch.setattr(server, "_PIECE", 1000)
    monkeypatch.setattr(server._Handler, "_write", waiting)
    return goes_on


def seen(tab: Browser, view: int, file: Path | str) -> float:
    """PSNR of a view in the page against a picture, dB."""
    wanted = np.asarray(Image.open(file), np.float64)
    return decibels(picture(tab, view, wanted.shape[1], wanted.shape[0]), wanted)


@contextmanager
def arriving(tab: Browser, scene: Path, cameras: str, goes_on: threading.Event, drawn: Drawn) -> Iterator[None]:
    """The page of a scene of which a part has come; at the end, the whole scene comes."""
    with served(scene, cameras, **LOOK) as address:
        tab.events.clear()
        tab.send("Page.navigate", url=address)
        tab.wait("Page.loadEventFired")
        until(tab, "globalThis.viewer && viewer.stats.firstMs > 0")
        yield
        assert tab.run("viewer.growth") == 1 and tab.run("viewer.stats.wholeMs") == 0
        goes_on.set()
        until(tab, "viewer.stats.wholeMs > 0")
        assert tab.run("viewer.rows") == tab.run("viewer.header.count") == GridContainer(scene).header.count
        assert seen(tab, POSES[1], drawn(False)[1]) >= 50
        assert faults(tab) == []


def test_a_preview_is_shown_until_the_first_layer_is_there(
    tab: Browser, scene: Path, sample_dir: Path, drawn: Drawn, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The server stops in the second of the chunks that the first layer has."""
    scene, small = previewed(scene, tmp_path, 8192)
    cameras = str(sample_dir / "cameras.json")
    second = GridContainer(scene).read_table()[1].section
    goes_on = stops_at(monkeypatch, second.offset + second.length // 2)
    (file,) = render_views(small, tmp_path / "small", views=[POSES[1]], cameras=cameras, **LOOK).files
    with arriving(tab, scene, cameras, goes_on, drawn):
        until(tab, "viewer.previewed?.waiting.length")
        assert seen(tab, POSES[1], file) >= 50


def patchwork(scene: Path, small: Path, here: list[int]) -> dict[str, np.ndarray]:
    """Rows of some chunks of the first layer, and of the preview what lies nearest to others of them."""
    header = GridContainer(scene).header
    chunks = [chunk for chunk in header.chunks() if chunk.layer == 0]
    boxes = np.array(header.settings["boxes"][: len(chunks)], np.float64)[:, :6] * header.grid_steps.position
    names = list(FIELD)
    whole, preview = GridSource(scene), GridSource(small)
    some = preview.read(slice(0, preview.count), names)
    low, high = boxes[:, :3, None], boxes[:, 3:, None]
    means = some["means"][None].astype(np.float64)
    away = np.sqrt((np.maximum(np.maximum(low - means, means - high), 0) ** 2).sum(axis=1))
    cost = np.where(away > 0, away, -1 / (high - low).prod(axis=1))
    left = ~np.isin(cost.argmin(axis=0), here)
    parts = [whole.read(slice(chunks[i].start, chunks[i].stop), names) for i in here]
    parts.append({name: plane[..., left] for name, plane in some.items()})
    coefficients = parts[0]["sh_rest"].shape[:-1]
    parts[-1]["sh_rest"] = np.zeros((*coefficients, int(left.sum())), np.float32)
    return {name: np.concatenate([part[name] for part in parts], axis=-1) for name in names}


def test_where_a_chunk_comes_the_preview_goes(
    tab: Browser, scene: Path, sample_dir: Path, drawn: Drawn, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a scene whose file tells where its chunks lie, the server stops behind some of those in sight."""
    scene, small = previewed(scene, tmp_path, 1024)
    cameras = str(sample_dir / "cameras.json")
    goes_on = stops_at(monkeypatch, GridContainer(scene).read_table()[1].section.offset + 120_000)
    with arriving(tab, scene, cameras, goes_on, drawn):
        until(tab, "viewer.space?.parts.some((part) => part.here)")
        told = "JSON.stringify([viewer.rows, viewer.space.parts.filter((part) => part.here).map((part) => part.index)])"
        found: list[str] = []
        while found[-1:] != found[-2:-1] or len(found) < 2:
            found.append(tab.run(told))
            time.sleep(1)
        rows, here = json.loads(found[-1])
        planes = patchwork(scene, small, sorted(here))
        assert rows == planes["means"].shape[-1]
        mixed = tmp_path / "mixed.ply"
        write_ply(mixed, MemorySource(planes, origin=GridSource(scene).origin))
        (file,) = render_views(mixed, tmp_path / "mixed", views=[POSES[0]], cameras=cameras, **LOOK).files
        assert seen(tab, POSES[0], file) >= 45
