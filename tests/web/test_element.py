"""`<flexgs-scene>` in a page of another server, and what a page does when it is mounted, removed, lost and loaded again."""

from __future__ import annotations

from pathlib import Path

import pytest

from browser import Browser
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.cameras.start import START, start_view
from flexgs_edge.codec.open_fgs import open_fgs
from flexgs_edge.codec.v2.container import write_grid
from flexgs_edge.commands.view import view
from flexgs_edge.scene.source import some_positions
from grid_scenes import sample_grid
from viewer_tab import faults, site, until

PAGE = """<!doctype html><html><head><link rel="icon" href="data:,"></head><body style="margin: 0"><h1>Somebody else's page</h1>
<script src="{folder}/flexgs-scene.js"></script>
<div id="place" style="width: 320px"></div><div style="height: 3000px"></div></body></html>"""
ONE = (
    '(() => {{ place.innerHTML = \'<flexgs-scene src="{folder}/scene.fgs" poster="{folder}/poster.jpg" {more}></flexgs-scene>\';'
    "globalThis.one = place.firstChild; one.told = []; for (const name of ['first', 'loaded', 'failed'])"
    "one.addEventListener(name, ({{ type, detail }}) => one.told.push([type, detail ?? null])); }})()"
)


@pytest.fixture(scope="module")
def folder(sample_dir: Path, scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("element")
    start = start_view(read_cameras(sample_dir / "cameras.json"), some_positions(open_fgs(scene)))
    write_grid(place / "a.fgs", sample_grid(sample_dir, 16), {START: start.to_json()})
    view(place / "a.fgs", place / "site")
    return place / "site"


def opened(tab: Browser, page: str) -> None:
    tab.events.clear()
    tab.send("Emulation.setDeviceMetricsOverride", width=400, height=500, deviceScaleFactor=1, mobile=False)
    tab.send("Page.navigate", url=page)
    tab.wait("Page.loadEventFired")


def test_an_element_from_another_server(tab: Browser, folder: Path, tmp_path: Path) -> None:
    with site(folder, others=True) as address, site(tmp_path) as page:
        (tmp_path / "index.html").write_text(PAGE.format(folder=address))
        opened(tab, f"{page}/index.html")
        tab.run(ONE.format(folder=address, more='turn="20"'))
        until(tab, "one.told.length === 2")
        assert sorted(tab.run("one.told")) == [["first", None], ["loaded", None]]
        assert tab.run("[one.clientWidth, one.clientHeight, one.shadowRoot.querySelectorAll('img').length]") == [
            320,
            180,
            0,
        ]
        eye = tab.run("one.viewer.camera.eye")
        until(tab, f"Math.abs(one.viewer.camera.eye[0] - {eye[0]}) > 0.05")  # it turns by itself
        # The page scrolls, until the scene is clicked.
        wheel = {"type": "mouseWheel", "x": 160, "y": 150, "deltaX": 0, "deltaY": 40}
        tab.send("Input.dispatchMouseEvent", **wheel)
        until(tab, "scrollY > 10")
        tab.run("scrollTo(0, 0)")
        for kind in ("mousePressed", "mouseReleased"):
            tab.send("Input.dispatchMouseEvent", type=kind, x=160, y=150, button="left", clickCount=1)
        distance = tab.run("one.viewer.camera.distance")
        tab.send("Input.dispatchMouseEvent", **wheel)
        until(tab, f"one.viewer.camera.distance > {distance} * 1.01")
        still = tab.run("one.viewer.camera.axes")
        assert tab.run("new Promise((done) => setTimeout(() => done(one.viewer.camera.axes), 300))") == still
        tab.run(ONE.format(folder=address, more='controls="none" view="9,8,7,0,0,0,0,0,1,50,40"'))
        until(tab, "one.told.length === 2")
        assert tab.run("one.viewer.camera.eye.map((v, i) => v + one.viewer.header.origin[i])") == pytest.approx(
            [9, 8, 7]
        )
        assert tab.run("getComputedStyle(one.shadowRoot.querySelector('canvas')).pointerEvents") == "none"
        tab.run("one.setAttribute('src', 'none.fgs')")
        until(tab, "one.told.length === 3")
        kind, text = tab.run("one.told[2]")
        assert kind == "failed" and "404" in text


def test_elements_leave_nothing_behind(tab: Browser, folder: Path) -> None:
    with site(folder) as address:
        (folder / "many.html").write_text(PAGE.format(folder=address))
        opened(tab, f"{address}/many.html")
        three = f"<flexgs-scene src='{address}/scene.fgs'></flexgs-scene>" * 3
        for turn in range(12):  # Chromium has 16 contexts
            tab.run(f'place.innerHTML = "{three}"')
            if turn % 4 == 3:
                until(tab, "[...place.children].every((one) => one.viewer?.stats.wholeMs > 0)")
            tab.run("place.replaceChildren()")
        assert not [event for event in tab.events if "Too many active WebGL contexts" in str(event)]
        workers = [target for target in tab.send("Target.getTargets")["targetInfos"] if target["type"] == "worker"]
        assert workers == []
        assert faults(tab) == []


def test_a_lost_device_comes_back(tab: Browser, folder: Path) -> None:
    with site(folder) as address:
        opened(tab, f"{address}/")
        until(tab, "globalThis.viewer?.stats.wholeMs > 0")
        tab.run("viewer.camera.orbit(0.4, 0); globalThis.gone = viewer.renderer.gl.getExtension('WEBGL_lose_context')")
        eye = tab.run("viewer.camera.eye")
        tab.run("gone.loseContext()")
        until(tab, "document.getElementById('status').textContent.includes('was lost')")
        tab.run("gone.restoreContext()")
        until(tab, "viewer.stats.wholeMs > 0 && viewer.renderer.drawn > 0 && !viewer.renderer.gl.isContextLost()")
        assert tab.run("viewer.camera.eye") == pytest.approx(eye, abs=1e-3)


def test_again_after_a_failure(tab: Browser, folder: Path) -> None:
    scene = folder / "scene.fgs"
    scene.rename(folder / "gone.fgs")
    with site(folder) as address:
        opened(tab, f"{address}/")
        until(tab, "document.querySelector('#status button')")
        assert "404" in tab.run("document.getElementById('status').textContent")
        (folder / "gone.fgs").rename(scene)
        tab.run("document.querySelector('#status button').click()")
        until(tab, "viewer.stats.wholeMs > 0")


def test_a_phone_draws_two_megapixels(tab: Browser, folder: Path) -> None:
    with site(folder) as address:
        tab.events.clear()
        tab.send("Emulation.setDeviceMetricsOverride", width=390, height=844, deviceScaleFactor=3, mobile=True)
        tab.send("Emulation.setTouchEmulationEnabled", enabled=True)
        try:
            tab.send("Page.navigate", url=f"{address}/")
            tab.wait("Page.loadEventFired")
            until(tab, "globalThis.viewer?.stats.wholeMs > 0 && !viewer.resting")
            width, height = tab.run("[viewer.view.width, viewer.view.height]")
            assert 1.9e6 < width * height <= 2e6 and height / width == pytest.approx(844 / 390, rel=0.01)
            # The time that the page shows is that of the device, not of its commands. Another process slows single frames.
            shown, read = tab.run(
                "(async () => { const { gl } = viewer.renderer; const pixel = new Uint8Array(4); let read = 1e9, shown = 1e9;"
                "for (let i = 0; i < 40 && (i < 3 || Math.abs(shown - read) > 0.1 * read); i++) {"
                "const start = performance.now(); viewer.renderer.draw(viewer.view, viewer.look, viewer.growth);"
                "gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel); read = Math.min(read, performance.now() - start);"
                "viewer.refresh(); await new Promise((done) => viewer.addEventListener('timed', done, { once: true }));"
                "shown = Math.min(shown, viewer.stats.frameMs); } return [shown, read]; })()"
            )
            assert shown == pytest.approx(read, rel=0.2, abs=8)
            tab.run("document.querySelector('summary').click()")
            small = tab.run(
                "[...document.querySelectorAll('button, summary, select, label')].filter((one) => one.offsetHeight < 44)"
                ".map((one) => one.outerHTML)"
            )
            assert small == []
            assert tab.run("document.getElementById('panel').offsetHeight <= 0.46 * innerHeight")
            assert tab.run("document.documentElement.scrollWidth <= innerWidth")
            tab.press("Escape", 27)
            assert tab.run("document.getElementById('panel').open") is False
        finally:
            tab.send("Emulation.setTouchEmulationEnabled", enabled=False)


def test_a_small_device_shows_what_covers_most(tab: Browser, folder: Path) -> None:
    script = (
        "const get = WebGL2RenderingContext.prototype.getParameter;"
        "WebGL2RenderingContext.prototype.getParameter = function (name) {"
        "return name === this.MAX_TEXTURE_SIZE ? 3 : get.call(this, name); };"
    )
    made = tab.send("Page.addScriptToEvaluateOnNewDocument", source=script)
    try:
        with site(folder) as address:
            opened(tab, f"{address}/")
            until(tab, "globalThis.viewer?.stats.wholeMs > 0")
            count, rows, drawn = tab.run("[viewer.header.count, viewer.rows, viewer.renderer.drawn]")
            assert 0 < rows <= 1536 < count and 0 < drawn <= rows
            assert f"room for {rows} of {count}" in tab.run("document.getElementById('status').textContent")
            assert tab.run("viewer.growth") > 1
            assert faults(tab) == []
    finally:
        tab.send("Page.removeScriptToEvaluateOnNewDocument", identifier=made["identifier"])
