"""A scene in pages of other people: React mounts and removes it; from disk; in iframes, from disk and from a server."""

from __future__ import annotations

import base64
import shutil
import time
from pathlib import Path

import pytest

from browser import Browser
from flexgs_edge.cameras.start import START, StartView
from flexgs_edge.codec.v2.container import write_grid
from flexgs_edge.commands.view import view
from grid_scenes import sample_grid
from viewer_tab import faults, site, until

REACT = """<!doctype html><meta charset="utf-8"><link rel="icon" href="data:,"><div id="root"></div>
<script src="react.js"></script><script src="react-dom.js"></script><script src="site/flexgs-scene.js"></script>
<script>
  const { createElement, StrictMode, useEffect, useRef, useState } = React;
  globalThis.told = [];
  globalThis.viewers = new Set();
  function Scene({ view }) {
    const ref = useRef(null);
    useEffect(() => {
      const element = ref.current;
      viewers.add(element.viewer);
      const hear = ({ type }) => told.push(type);
      for (const name of ['first', 'loaded', 'failed']) element.addEventListener(name, hear);
      return () => ['first', 'loaded', 'failed'].forEach((name) => element.removeEventListener(name, hear));
    }, []);
    return createElement('flexgs-scene', { ref, src: 'site/scene.fgs', view, style: { width: '320px' } });
  }
  function App() {
    const [props, set] = useState(null);
    globalThis.show = set;
    return props && createElement(Scene, props);
  }
  ReactDOM.createRoot(document.getElementById('root')).render(createElement(StrictMode, null, createElement(App)));
</script>"""
ELEMENT = "document.querySelector('flexgs-scene')"
EYE = f"{ELEMENT}.viewer.camera.eye.map((value, i) => value + {ELEMENT}.viewer.header.origin[i])"
OTHER = "9,8,7,0,0,0,0,0,1,50,40"


@pytest.fixture(scope="module")
def folder(sample_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of `view`, and a page of one file."""
    place = tmp_path_factory.mktemp("pages")
    start = StartView((0.0, -0.5, -3.0), (0.0, 0.0, 3.0), (0.0, -1.0, 0.0), (60.0, 40.0))
    write_grid(place / "scene.fgs", sample_grid(sample_dir, 16), {START: start.to_json()})
    view(place / "scene.fgs", place / "site")
    view(place / "scene.fgs", place / "page.html")
    return place


def opened(tab: Browser, address: str) -> None:
    tab.events.clear()
    tab.send("Emulation.setDeviceMetricsOverride", width=400, height=500, deviceScaleFactor=1, mobile=False)
    tab.send("Page.navigate", url=address)
    tab.wait("Page.loadEventFired")


def test_react_mounts_changes_and_removes_it(tab: Browser, folder: Path, node_modules: Path) -> None:
    for package, name in (("react", "react.js"), ("react-dom", "react-dom.js")):
        script = node_modules / package / "umd" / f"{package}.development.js"
        if not script.is_file():
            pytest.skip(f"no {package} in {node_modules}: npm install react@18.3.1 react-dom@18.3.1")
        shutil.copy(script, folder / name)
    (folder / "react.html").write_text(REACT)
    with site(folder) as address:
        opened(tab, f"{address}/react.html")
        until(tab, "globalThis.show")
        for _ in range(3):
            tab.run("(() => { told.length = 0; show({}); })()")
            until(tab, "told.length === 2")
            assert sorted(tab.run("told")) == ["first", "loaded"]
            assert tab.run(EYE) == pytest.approx([0.0, -0.5, -3.0])
            tab.run(f"(() => {{ told.length = 0; show({{ view: '{OTHER}' }}); }})()")
            until(tab, "told.length === 2")
            assert tab.run(EYE) == pytest.approx([9.0, 8.0, 7.0])
            tab.run("show(null)")
            until(tab, f"!{ELEMENT}")
        # All that were made have let go of the device and their workers.
        assert tab.run("[viewers.size, [...viewers].every((one) => one.ending.signal.aborted)]") == [3, True]
        assert tab.run("[...viewers].every((one) => one.renderer.gl.isContextLost())")
        assert faults(tab) == []


def test_a_plain_page_from_disk(tab: Browser, folder: Path) -> None:
    """Pages from disk may fetch no files: the scene is in the page, as data."""
    data = base64.b64encode((folder / "scene.fgs").read_bytes()).decode()
    (folder / "plain.html").write_text(
        '<!doctype html><meta charset="utf-8"><body><script src="site/flexgs-scene.js"></script>'
        f'<flexgs-scene src="data:application/octet-stream;base64,{data}"></flexgs-scene>'
    )
    opened(tab, (folder / "plain.html").as_uri())
    until(tab, f"{ELEMENT}.viewer.stats.wholeMs && {ELEMENT}.viewer.stats.firstMs")
    assert tab.run(f"{ELEMENT}.viewer.rows") == tab.run(f"{ELEMENT}.viewer.header.count")
    assert tab.run(EYE) == pytest.approx([0.0, -0.5, -3.0])
    assert faults(tab) == []


@pytest.mark.parametrize("source", ["site/index.html", "page.html"])
@pytest.mark.parametrize("from_disk", [True, False])
def test_an_iframe(tab: Browser, folder: Path, source: str, from_disk: bool) -> None:
    if from_disk and source.startswith("site"):
        pytest.skip("a folder needs a web server: its page says so")
    (folder / "frame.html").write_text(
        f'<!doctype html><link rel="icon" href="data:,"><iframe src="{source}" width="320" height="240"></iframe>'
    )
    with site(folder) as address:
        opened(tab, (folder / "frame.html").as_uri() if from_disk else f"{address}/frame.html")
        for _ in range(300):
            if in_frame(tab, "Boolean(globalThis.viewer?.stats.wholeMs && viewer.stats.firstMs)"):
                break
            time.sleep(0.1)
        assert in_frame(tab, "viewer.rows === viewer.header.count && viewer.renderer.drawn > 1000")
        assert faults(tab) == []


def in_frame(tab: Browser, expression: str) -> bool:
    """The value of an expression in the page of the iframe, which is the last that began."""
    begun = [event for event in tab.events if event.get("method") == "Runtime.executionContextCreated"]
    context = begun[-1]["params"]["context"]["id"]
    answer = tab.send("Runtime.evaluate", expression=expression, returnByValue=True, contextId=context)
    return answer["result"].get("value") is True
