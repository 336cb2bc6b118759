"""Where pages start: in a folder for a web site, on the hosted page, by a link, and for a file that is dropped."""

from __future__ import annotations

import base64
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pytest
from PIL import Image

from browser import Browser
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.cameras.start import START, StartView, start_view
from flexgs_edge.codec.open_fgs import open_fgs
from flexgs_edge.codec.v2.container import write_grid
from flexgs_edge.commands.view import view
from flexgs_edge.scene.source import some_positions
from grid_scenes import sample_grid
from viewer_tab import decibels, faults, go, picture, requests, served, site, until


@pytest.fixture(scope="module")
def start(sample_dir: Path, scene: Path) -> StartView:
    return start_view(read_cameras(sample_dir / "cameras.json"), some_positions(open_fgs(scene)))


@pytest.fixture(scope="module")
def started(sample_dir: Path, start: StartView, tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("started") / "still_life.fgs"
    write_grid(place, sample_grid(sample_dir, 4), {START: start.to_json()}, chunk_rows=2048)
    return place


def eye(tab: Browser) -> list[float]:
    return tab.run("[...viewer.camera.eye.map((v, i) => v + viewer.header.origin[i]), ...viewer.camera.target]")[:3]


def test_a_folder_is_a_web_site(tab: Browser, started: Path, start: StartView, tmp_path: Path) -> None:
    result = view(started, tmp_path / "site")
    names = sorted(path.name for path in (tmp_path / "site").iterdir())
    assert names == ["embed.txt", "flexgs-scene.js", "index.html", "poster.jpg", "scene.fgs"]
    assert result.page_size == sum(path.stat().st_size for path in (tmp_path / "site").iterdir())
    poster = np.asarray(Image.open(tmp_path / "site" / "poster.jpg"), np.float64)
    with site(tmp_path / "site") as address:
        go(tab, f"{address}/")
        assert tab.run("[viewer.poses.at(-1).name, viewer.pose, viewer.poses.length]") == ["start", 0, 1]
        assert eye(tab) == pytest.approx(start.eye) and tab.run("viewer.camera.up") == pytest.approx(start.up)
        assert tab.run("document.getElementById('poster')") is None
        asked = [event["params"]["request"]["url"].rpartition("/")[2] for event in requests(tab)]
        assert asked == ["", "poster.jpg"]  # and the scene, by a worker
        assert decibels(picture(tab, 0, 960, 540), poster) > 30
        tab.send("Browser.grantPermissions", permissions=["clipboardReadWrite", "clipboardSanitizedWrite"])
        tab.run("viewer.camera.orbit(0.5, 0.1)")
        turned = eye(tab)
        tab.run("document.getElementById('link').click()")
        until(tab, "document.getElementById('status').textContent.includes('copied')")
        link = tab.run("navigator.clipboard.readText()")
        assert link.startswith(f"{address}/?view=")
        go(tab, link)
        assert eye(tab) == pytest.approx(turned, abs=1e-4) and turned != pytest.approx(start.eye)
        assert faults(tab) == []


def test_a_hosted_page_and_a_dropped_file_start_there_too(
    tab: Browser, repository: Path, started: Path, start: StartView, tmp_path: Path
) -> None:
    (tmp_path / "web").symlink_to(repository / "web")
    (tmp_path / "scene.fgs").write_bytes(started.read_bytes())
    with site(tmp_path) as address:
        go(tab, f"{address}/web/viewer/index.html?scene=/scene.fgs")
        assert eye(tab) == pytest.approx(start.eye)
        go(tab, f"{address}/web/viewer/index.html?scene=/scene.fgs&view=" + quote("9,8,7,0,0,0,0,0,1,50,40"))
        assert eye(tab) == pytest.approx([9, 8, 7])
        data = base64.b64encode(started.read_bytes()).decode()
        tab.run(
            f"(async () => {{ const bytes = await (await fetch('data:;base64,{data}')).arrayBuffer();"
            "const list = new DataTransfer(); list.items.add(new File([bytes], 'dropped.fgs'));"
            "document.dispatchEvent(new DragEvent('drop', { dataTransfer: list })); })()"
        )
        until(tab, "document.title.startsWith('dropped') && viewer.stats.wholeMs > 0")
        assert eye(tab) == pytest.approx(start.eye)


def test_modules_do_not_load_from_disk_and_the_page_says_so(tab: Browser, repository: Path) -> None:
    tab.send("Page.navigate", url=(repository / "web" / "viewer" / "index.html").as_uri())
    tab.wait("Page.loadEventFired")
    until(tab, "document.getElementById('status').textContent.includes('needs a web server')")


def test_a_list_of_cameras_comes_before_the_start_view(
    tab: Browser, started: Path, start: StartView, sample_dir: Path
) -> None:
    with served(started, str(sample_dir / "cameras.json")) as address:
        go(tab, address)
        count = len(read_cameras(sample_dir / "cameras.json"))
        assert tab.run("[viewer.pose, viewer.poses.length, document.getElementById('pose').value]") == [
            count,
            count + 1,
            str(count),
        ]
        assert eye(tab) == pytest.approx(start.eye)
        tab.press("]", 221)
        assert tab.run("viewer.pose") == 0
