"""The viewer in headless Chromium: its pictures are those of `render`, and its buttons and keys do what they say."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from browser import Browser
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.codec.open_fgs import open_fgs
from flexgs_edge.codec.v2.container import GridContainer, write_grid
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.commands.compress import fine_steps
from flexgs_edge.commands.render import render_views
from flexgs_edge.commands.trim import trim
from flexgs_edge.commands.view import view
from flexgs_edge.grid.to_grid import to_grid
from flexgs_edge.io.ply import write_ply
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import GrownSource, MemorySource
from viewer_tab import LOOK, POSES, Drawn, decibels, drag, faults, go, picture, requests, served, site, until
from web_vectors import FOLDER


@pytest.mark.parametrize(("distance", "coded"), [(3e4, False), (2e7, True)], ids=["ply", "grid"])
def test_far_gaussians_leave_near_ones_their_places(
    tab: Browser, scene: Path, sample_dir: Path, tmp_path: Path, distance: float, coded: bool
) -> None:
    """Opaque Gaussians in sight, far behind an object: a scene that `view` codes on the fly, and one on a grid."""
    source, cameras = open_fgs(scene), str(sample_dir / "cameras.json")
    planes = source.read(slice(0, source.count), list(FIELD))
    rows = np.flatnonzero(np.abs(planes["means"]).max(axis=0) < 2.2)
    planes = {name: values[:, rows] for name, values in planes.items()}
    rng = np.random.default_rng(5)
    ways = [read_cameras(cameras)[pose].rotation.T @ [*rng.uniform(-0.4, 0.4, 2), 1] for pose in POSES * 13]
    rows = rng.permutation(len(rows))[: len(ways)]
    away = distance * np.geomspace(0.5, 1, len(ways))  # at equal depths, any rounding would change who covers whom
    planes["means"][:, rows] = away * np.array(ways).T
    planes["log_scales"][:, rows] = np.log(0.02 * away)
    planes["opacity_logits"][:, rows] = 5
    path = tmp_path / ("far.fgs" if coded else "far.ply")
    if coded:
        steps = fine_steps(planes["means"], planes["log_scales"], 3)
        assert steps.contraction is not None
        write_grid(path, to_grid(planes, np.full(planes["means"].shape[1], 3), steps, np.zeros(3))[0], {})
    else:
        write_ply(path, MemorySource(planes))
    files = render_views(path, tmp_path / "drawn", views=POSES, cameras=cameras, **LOOK).files
    with served(path, cameras, **LOOK) as address:
        go(tab, address)
        for pose, file in zip(POSES, files, strict=True):
            wanted = np.asarray(Image.open(file), np.float64)
            assert decibels(picture(tab, pose, wanted.shape[1], wanted.shape[0]), wanted) >= 45, pose


@pytest.mark.parametrize(
    ("bits", "antialiased", "least"),
    [(16, False, 50), (8, False, 40), (16, True, 50)],
    ids=["half", "bytes", "antialiased"],
)
def test_pictures_are_those_of_render(
    tab: Browser, scene: Path, sample_dir: Path, drawn: Drawn, bits: int, antialiased: bool, least: float
) -> None:
    files = drawn(antialiased)
    with served(scene, str(sample_dir / "cameras.json"), **LOOK, antialiased=antialiased) as address:
        go(tab, f"{address}?bits={bits}")
        assert tab.run("viewer.renderer.half") is (bits == 16)
        for pose, file in zip(POSES, files, strict=True):
            wanted = np.asarray(Image.open(file), np.float64)
            got = picture(tab, pose, wanted.shape[1], wanted.shape[0])
            assert decibels(got, wanted) >= least, pose
        assert faults(tab) == []
        hosts = {event["params"]["request"]["url"].split("/")[2] for event in requests(tab)}
        assert hosts == {address.split("/")[2]}


def test_a_ply_is_shown_too(tab: Browser, sample_dir: Path, tmp_path: Path) -> None:
    """Coded with 16 bits a value, as a file of version 1."""
    cameras, scene = str(sample_dir / "cameras.json"), sample_dir / "point_cloud.ply"
    (file,) = render_views(scene, tmp_path, views=[3], cameras=cameras).files
    with served(scene, cameras) as address:
        go(tab, address)
        assert tab.run("viewer.header.version") == 1
        wanted = np.asarray(Image.open(file), np.float64)
        assert decibels(picture(tab, 3, wanted.shape[1], wanted.shape[0]), wanted) >= 50


def test_what_is_there_of_a_cut_file_is_drawn_larger(
    tab: Browser, scene: Path, sample_dir: Path, tmp_path: Path
) -> None:
    """Half of the rows: as large as docs/drawing.md says, in a cut file and while the rest is on its way."""
    cameras = str(sample_dir / "cameras.json")
    whole = open_fgs(scene)
    count = whole.container.header.layers[0]
    cut, grown = tmp_path / "cut.fgs", tmp_path / "grown.ply"
    trim(scene, cut, scene.stat().st_size - 1)
    write_ply(grown, GrownSource(whole.select(np.arange(count)), whole.count))
    (file,) = render_views(grown, tmp_path / "grown", views=[3], cameras=cameras).files
    wanted = np.asarray(Image.open(file), np.float64)
    (file,) = render_views(cut, tmp_path / "cut", views=[3], cameras=cameras).files
    np.testing.assert_array_equal(np.asarray(Image.open(file)), wanted)
    with served(cut, cameras) as address:
        go(tab, address)
        assert decibels(picture(tab, 3, wanted.shape[1], wanted.shape[0]), wanted) >= 50
        assert tab.run("viewer.growth") == pytest.approx(2**0.125, rel=1e-3)
    with served(scene, cameras) as address:
        go(tab, address)
        assert tab.run("viewer.growth") == 1
        assert tab.run("(() => { viewer.rows /= 2; return viewer.growth; })()") == pytest.approx(2**0.125)


@pytest.fixture(scope="module")
def spatial(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same scene in so many chunks that its file tells where they lie."""
    place = tmp_path_factory.mktemp("spatial") / "still_life.fgs"
    source = open_fgs(scene)
    assert isinstance(source, GridSource)
    write_grid(place, source.grid(), {}, chunk_rows=256)
    return place


def test_chunks_in_sight_come_first(tab: Browser, spatial: Path, sample_dir: Path, drawn: Drawn) -> None:
    """The last picture is that of `render`, whatever the order in which chunks came."""
    header = GridContainer(spatial).header
    with served(spatial, str(sample_dir / "cameras.json"), **LOOK) as address:
        go(tab, address)
        assert tab.run("viewer.space.complete")
        assert tab.run("viewer.rows") == header.count
        for pose, file in zip(POSES, drawn(False), strict=True):
            wanted = np.asarray(Image.open(file), np.float64)
            assert decibels(picture(tab, pose, wanted.shape[1], wanted.shape[0]), wanted) >= 50, pose
    assert faults(tab) == []


def test_a_page_of_one_file_knows_what_is_in_sight(
    tab: Browser, spatial: Path, sample_dir: Path, tmp_path: Path
) -> None:
    page = tmp_path / "page.html"
    view(spatial, page, cameras=str(sample_dir / "cameras.json"))
    go(tab, page.as_uri())
    assert tab.run("viewer.space.complete")
    assert faults(tab) == []


def test_a_damaged_chunk_ends_a_scene_that_comes_by_sight(
    tab: Browser, spatial: Path, sample_dir: Path, tmp_path: Path
) -> None:
    damaged = tmp_path / "damaged.fgs"
    data = bytearray(spatial.read_bytes())
    data[GridContainer(spatial).read_table()[20].section.offset + 9] ^= 1
    damaged.write_bytes(data)
    with served(damaged, str(sample_dir / "cameras.json")) as address:
        tab.send("Page.navigate", url=address)
        tab.wait("Page.loadEventFired")
        until(tab, "document.querySelector('#status.error')")
        assert "chunk 20" in tab.run("document.getElementById('status').textContent")
        assert tab.run("viewer.renderer.drawn") == 0


def test_a_browser_without_webgl2_is_told_so(tab: Browser, scene: Path) -> None:
    script = "HTMLCanvasElement.prototype.getContext = () => null"
    added = tab.send("Page.addScriptToEvaluateOnNewDocument", source=script)["identifier"]
    try:
        with served(scene, "none") as address:
            tab.send("Page.navigate", url=address)
            tab.wait("Page.loadEventFired")
            until(tab, "document.querySelector('#status.error')")
            assert "needs WebGL2" in tab.run("document.getElementById('status').textContent")
    finally:
        tab.send("Page.removeScriptToEvaluateOnNewDocument", identifier=added)


def eye(tab: Browser) -> list[float]:
    found: list[float] = tab.run("[...viewer.camera.eye, ...viewer.camera.axes.flat()]")
    return found


def hold(tab: Browser, key: str, code: str) -> None:
    """Hold a key until the camera has moved; frames in software take their time."""
    state = "JSON.stringify([viewer.camera.eye, viewer.camera.axes])"
    before = tab.run(state)
    tab.send("Input.dispatchKeyEvent", type="keyDown", key=key, code=code)
    until(tab, f"{state} !== {json.dumps(before)}")
    tab.send("Input.dispatchKeyEvent", type="keyUp", key=key, code=code)


def test_mouse_touch_and_keys(tab: Browser, scene: Path, sample_dir: Path) -> None:
    with served(scene, str(sample_dir / "cameras.json")) as address:
        go(tab, address)
        names = [camera.name for camera in read_cameras(sample_dir / "cameras.json")]
        assert tab.run("[...document.getElementById('pose').options].map((o) => o.text)") == sorted(names)
        distance = tab.run("viewer.camera.distance")
        start = eye(tab)
        drag(tab, 60, 20)
        turned = eye(tab)
        assert turned != start and tab.run("viewer.camera.distance") == pytest.approx(distance)
        drag(tab, 60, 20, "right")
        assert eye(tab)[3:] == turned[3:] and eye(tab)[:3] != turned[:3]
        tab.send("Input.dispatchMouseEvent", type="mouseWheel", x=200, y=200, deltaX=0, deltaY=-200)
        until(tab, f"viewer.camera.distance < {distance} * 0.9")
        tab.run("document.getElementById('canvas').focus()")
        for key, code in (("w", "KeyW"), ("ArrowLeft", "ArrowLeft"), ("e", "KeyE")):
            hold(tab, key, code)
        assert not tab.run("viewer.controls.active")
        before = eye(tab)
        points = [[{"x": 150 - 10 * i, "y": 200}, {"x": 250 + 10 * i, "y": 200}] for i in range(4)]
        tab.send("Input.dispatchTouchEvent", type="touchStart", touchPoints=points[0])
        for both in points[1:]:
            tab.send("Input.dispatchTouchEvent", type="touchMove", touchPoints=both)
        tab.send("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
        assert eye(tab) != before
        tab.press("r", 82)
        assert eye(tab) == pytest.approx(start)
        tab.press("]", 221)
        assert tab.run("[viewer.pose, document.getElementById('pose').value]") == [1, "1"]
        # Keys belong to the page: no click is needed, and a checkbox takes none; brackets come with Alt on many keyboards.
        tab.run(
            "viewer.setPose(0); document.getElementById('panel').open = true; document.getElementById('fly').focus()"
        )
        before = eye(tab)
        hold(tab, "w", "KeyW")
        assert eye(tab)[:3] != before[:3]
        event = "new KeyboardEvent('keydown', { key: ']', altKey: true, ctrlKey: true, bubbles: true })"
        tab.run(f"document.getElementById('fly').dispatchEvent({event})")
        assert tab.run("viewer.pose") == 1
        before = eye(tab)
        event = "new KeyboardEvent('keydown', { key: 'w', code: 'KeyW', bubbles: true })"
        tab.run(f"document.getElementById('background').dispatchEvent({event})")
        assert not tab.run("viewer.controls.active") and eye(tab) == before
        tab.run("viewer.setPose(0)")
        target = tab.run("JSON.stringify(viewer.camera.target)")
        tab.run("viewer.focus(300, 200)")  # what a double click does
        until(tab, f"JSON.stringify(viewer.camera.target) !== {json.dumps(target)}")
        assert faults(tab) == []


def change(tab: Browser, name: str, value: str) -> None:
    tab.run(
        f"(() => {{ const field = document.getElementById('{name}');"
        f"if (field.type === 'checkbox') field.checked = {json.dumps(value)} === 'on'; else field.value = {json.dumps(value)};"
        "field.dispatchEvent(new Event('input')); })()"
    )


def test_the_panel_on_a_phone_in_the_dark(tab: Browser, scene: Path, sample_dir: Path) -> None:
    with served(scene, str(sample_dir / "cameras.json")) as address:
        go(tab, address, 360, 640, dark=True)
        tab.run("document.querySelector('summary').click()")
        assert tab.run("document.documentElement.scrollWidth <= innerWidth")
        assert tab.run("getComputedStyle(document.body).color") == "rgb(236, 238, 241)"
        change(tab, "theme", "light")
        assert tab.run("getComputedStyle(document.body).color") == "rgb(28, 29, 31)"
        full = picture(tab, 0, 120, 90)
        change(tab, "degree", "0")
        plain = picture(tab, 0, 120, 90)
        assert decibels(full, plain) < 60
        change(tab, "degree", "3")
        change(tab, "background", "#ff0000")
        change(tab, "antialiased", "on")
        assert tab.run("[viewer.look.background, viewer.look.antialiased]") == [[1, 0, 0], True]
        drawn = tab.run("viewer.renderer.drawn")
        change(tab, "share", "50")
        until(tab, f"!viewer.sorting && viewer.renderer.drawn < 0.6 * {drawn}")
        change(tab, "fly", "on")
        assert tab.run("viewer.controls.fly") is True
        tab.run("document.getElementById('more').open = true")
        assert tab.run("document.getElementById('numbers').innerText").count("ms") >= 4
        # Every field has a name for those who hear the page.
        assert tab.run("[...document.querySelectorAll('input, select')].every((f) => f.labels.length === 1)")
        assert faults(tab) == []


def test_a_damaged_file_is_no_scene(tab: Browser, scene: Path, sample_dir: Path, tmp_path: Path) -> None:
    data = bytearray(scene.read_bytes())
    with served(scene, str(sample_dir / "cameras.json")) as address:
        good = bytes(data)
        data[-3000] ^= 1
        scene.write_bytes(data)
        try:
            tab.send("Page.navigate", url=address)
            tab.wait("Page.loadEventFired")
            until(tab, "document.querySelector('#status.error')")
            text = tab.run("document.getElementById('status').textContent")
        finally:
            scene.write_bytes(good)
    assert "checksum: wanted" in text and "the file is damaged" in text
    assert tab.run("viewer.renderer.drawn") == 0


def test_the_decoder_runs_in_a_worker_of_another_page(tab: Browser, repository: Path) -> None:
    """As an npm package would: modules from a server, the file by ranges or as a stream, errors with their byte."""
    with site(repository / "web" / "decoder") as address:
        vectors = f"{address}/tests/vectors"
        tab.send("Page.navigate", url=f"{vectors}/vectors.json")
        tab.wait("Page.loadEventFired")
        script = """(async (source) => {
            const { openInWorker } = await import('/src/worker-client.js');
            const file = await openInWorker(source);
            const seen = [];
            for await (const chunk of file.chunks({ values: true })) {
                seen.push([chunk.rows, chunk.values.means.length, Number.isFinite(chunk.values.shRest[0])]);
            }
            await file.close();
            return seen;
        })"""
        name = "three_chunks_of_512_rows_in_two_layers.fgs"
        wanted = [[rows, 3 * rows, True] for rows in chunk_rows(FOLDER / name)]
        assert tab.run(f"{script}('{name}')") == wanted
        assert tab.run(f"fetch('{name}').then((answer) => answer.blob()).then({script})") == wanted
        failed = tab.run(f"{script}('vectors.json').catch((error) => [error.name, error.offset, error.message])")
        assert failed[:2] == ["FgsError", 0] and "not a .fgs file" in failed[2]


def chunk_rows(path: Path) -> list[int]:
    return [chunk.stop - chunk.start for chunk in GridContainer(path).header.chunks()]


def test_a_page_of_one_file_opens_from_disk(tab: Browser, scene: Path, sample_dir: Path, tmp_path: Path) -> None:
    page = tmp_path / "scene.html"
    view(scene, page, cameras=str(sample_dir / "cameras.json"))
    go(tab, page.as_uri())
    assert tab.run("viewer.rows") == tab.run("viewer.header.count") > 5000
    assert [event["params"]["request"]["url"] for event in requests(tab)] == [page.as_uri()]
    assert faults(tab) == []
    assert picture(tab, 0, 120, 90).std() > 10
