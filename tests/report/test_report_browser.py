"""The page of the bundled scene in a real browser: slider, switch, widths, colours, and silence on the line."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from browser import Browser, find_browser
from flexgs_edge.commands.compress import compress

PHONE, DESK = 360, 1280


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    program = find_browser()
    if program is None:
        pytest.skip("no Chromium here: sudo apt install chromium")
    with Browser(program, tmp_path_factory.mktemp("profile")) as found:
        yield found


@pytest.fixture(scope="module")
def page(browser: Browser, sample_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample's page; drawn small, and pruned so much that pictures differ."""
    folder = tmp_path_factory.mktemp("sample")
    compress(
        sample_dir / "point_cloud.ply", folder / "a.fgs", report=str(folder / "page"), method="paper", effort="fast",
        max_drop=2.0, resolution=160, holdout=20,
    )  # fmt: skip
    return folder / "page" / "index.html"


def pixels(png: bytes) -> np.ndarray:
    """[H, W, 3] f64."""
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"), np.float64)


def stage(browser: Browser) -> np.ndarray:
    return pixels(browser.picture("#view-1 .stage"))


def slide(browser: Browser, value: int) -> None:
    """The slider to a value, by keys from its end."""
    browser.run("document.querySelector('#view-1 input[type=range]').focus()")
    browser.press("Home", 36)
    for _ in range(value // 10):
        browser.press("PageUp", 33)
    found = browser.run("document.querySelector('#view-1 input[type=range]').value")
    assert int(found) == value


@pytest.mark.parametrize("width", [PHONE, DESK])
@pytest.mark.parametrize("dark", [False, True])
def test_nothing_is_fetched_nothing_fails_nothing_sticks_out(
    browser: Browser, page: Path, width: int, dark: bool
) -> None:
    browser.open(page, width, dark=dark)
    slide(browser, 70)
    browser.run("document.querySelectorAll('details').forEach(d => d.open = true)")
    assert browser.run("[document.documentElement.scrollWidth, innerWidth]") == [width, width]
    loaded = "[...document.images].map(i => i.complete && i.naturalWidth > 0)"
    assert all(browser.run(loaded)) and len(browser.run(loaded)) == 4 * 5
    requests = [e["params"]["request"]["url"] for e in browser.events if e.get("method") == "Network.requestWillBeSent"]
    assert [url for url in requests if not url.startswith("data:")] == [page.as_uri()]
    loud = ("Runtime.consoleAPICalled", "Runtime.exceptionThrown", "Log.entryAdded")
    assert [event for event in browser.events if event.get("method") in loud] == []
    ground = browser.run("getComputedStyle(document.body).backgroundColor")
    assert (sum(map(int, ground[4:-1].split(","))) < 200) == dark


@pytest.mark.parametrize("width", [PHONE, DESK])
def test_the_slider_wipes_between_original_and_compressed(browser: Browser, page: Path, width: int) -> None:
    browser.open(page, width)
    shots = {}
    for value in (0, 50, 100):
        slide(browser, value)
        shots[value] = stage(browser)
    compressed, half, original = shots[0], shots[50], shots[100]
    across = half.shape[1]
    # Away from the line, the labels at the bottom and the round corners.
    body, left, right = slice(20, -50), slice(20, across // 2 - 10), slice(across // 2 + 10, across - 20)
    assert np.abs(original - compressed)[body, left].mean() > 0.5 < np.abs(original - compressed)[body, right].mean()
    assert np.array_equal(half[body, left], original[body, left]), "left of the line"
    assert np.array_equal(half[body, right], compressed[body, right]), "right of it"
    words = browser.run("document.querySelector('#view-1 input[type=range]').getAttribute('aria-valuetext')")
    assert words == "100 % original, the rest compressed"


def test_the_switch_shows_error_maps_and_photo(browser: Browser, page: Path) -> None:
    browser.open(page, PHONE)
    slide(browser, 0)
    shown = {"compressed": stage(browser)}
    for kind in ("error", "flip", "photo"):
        browser.run(f"document.querySelector('#view-1 input[value={kind}]').focus()")
        browser.press(" ", 32)
        shown[kind] = stage(browser)
    body = slice(20, -50)
    assert shown["error"][body].mean() < 0.5 * shown["compressed"][body].mean(), "dark where nothing is lost"
    assert all(np.abs(shown["flip"] - shown[kind])[body].mean() > 2 for kind in ("error", "compressed"))
    assert 0.5 < np.abs(shown["photo"] - shown["compressed"])[body].mean() < 30


def test_dragging_on_the_picture_moves_the_line(browser: Browser, page: Path) -> None:
    browser.open(page, DESK)
    x, y, across = browser.run(
        "(b => [b.x, b.y, b.width])(document.querySelector('#view-1 .stage').getBoundingClientRect())"
    )
    for kind, share in (("mousePressed", 0.5), ("mouseMoved", 0.8), ("mouseReleased", 0.8)):
        place = {"x": x + share * across, "y": y + 100, "button": "left", "buttons": 1, "clickCount": 1}
        browser.send("Input.dispatchMouseEvent", type=kind, **place)
    assert browser.run("document.querySelector('#view-1 input[type=range]').value") == "80"


def test_without_script_all_pictures_are_there(browser: Browser, page: Path) -> None:
    browser.open(page, PHONE, script=False)
    # Scripts of the page are off; those of the test are not.
    found = browser.run(
        "[...document.querySelectorAll('.stage img')].map(i => i.getBoundingClientRect()).map(b => [b.width, b.height, b.y])"
    )
    assert len(found) == 4 * 5 and all(width > 100 and height > 70 for width, height, _ in found)
    assert len({(round(y)) for _, _, y in found}) == 12, "three rows for each view: nothing lies on anything"
    assert browser.run("getComputedStyle(document.querySelector('.controls')).display") == "none"
