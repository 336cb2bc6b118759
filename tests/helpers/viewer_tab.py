"""What the tests of drawing pages ask a browser for."""

from __future__ import annotations

import base64
import io
import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from PIL import Image

from browser import Browser
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.commands.view import view
from flexgs_edge.viewer.assets import PAGE
from flexgs_edge.viewer.server import SceneServer

POSES = (0, 27, 53)
LOOK: dict[str, Any] = {"background": (0.2, 0.4, 0.9)}
Drawn = Callable[[bool], tuple[str, ...]]
"""Files of these poses, antialiased or not, as `render` draws them."""
SOFTWARE = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")


class Tab(Protocol):
    """A page in any browser."""

    events: list[dict[str, Any]]

    def run(self, expression: str) -> Any:
        """The value of a JavaScript expression in the page."""


@contextmanager
def served(scene: Path, cameras: str, **words: Any) -> Iterator[str]:
    """The address of the viewer's page."""
    ready: list[SceneServer] = []
    event = threading.Event()

    def started(server: SceneServer) -> None:
        ready.append(server)
        event.set()

    thread = threading.Thread(
        target=lambda: view(scene, browser=False, ready=started, cameras=cameras, **words), daemon=True
    )
    thread.start()
    assert event.wait(60)
    try:
        yield ready[0].address(PAGE)
    finally:
        ready[0].stop()
        thread.join(20)


class _Quiet(SimpleHTTPRequestHandler):
    others = False

    def end_headers(self) -> None:
        if self.others:
            self.send_header("Access-Control-Allow-Origin", "*")
        super().end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        pass


@contextmanager
def site(folder: Path, others: bool = False) -> Iterator[str]:
    """The address of a plain web server of a folder: no ranges. `others`: pages of other servers may read it."""
    handler = type("Handler", (_Quiet,), {"others": others})
    web = ThreadingHTTPServer(("127.0.0.1", 0), partial(handler, directory=str(folder)))
    threading.Thread(target=web.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{web.server_port}"
    finally:
        web.shutdown()
        web.server_close()


def go(tab: Browser, address: str, width: int = 480, height: int = 360, dark: bool = False) -> None:
    """Load the page and wait for the whole scene."""
    tab.events.clear()
    tab.send("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 400)
    scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
    tab.send("Emulation.setEmulatedMedia", features=[scheme])
    tab.send("Page.navigate", url=address)
    tab.wait("Page.loadEventFired")
    until(tab, "globalThis.viewer && viewer.stats.wholeMs > 0 && viewer.stats.firstMs > 0")


def until(tab: Tab, condition: str) -> None:
    for _ in range(1800):
        if tab.run(f"Boolean({condition})"):
            return
        time.sleep(0.1)
    raise AssertionError(
        f"not within three minutes: {condition}; {tab.run('document.body.innerText')!r}, {faults(tab)}"
    )


def faults(tab: Tab) -> list[str]:
    """What went wrong in the page: exceptions, refused requests, broken policies."""
    names = ("Runtime.exceptionThrown", "Log.entryAdded", "Network.loadingFailed")
    found = [event for event in tab.events if event.get("method") in names]
    # A request that the page itself has given up is none.
    return [json.dumps(event)[:500] for event in found if not event["params"].get("canceled")]


def pose_of(camera: Camera) -> dict[str, Any]:
    """A camera, for a page."""
    names = ("width", "height", "fx", "fy", "cx", "cy")
    numbers = {name: getattr(camera, name) for name in names}
    return {"rotation": camera.rotation.tolist(), "position": camera.center.tolist(), **numbers}


def decibels(one: np.ndarray, two: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / max(((one - two) ** 2).mean(), 1e-9)))


def requests(tab: Browser) -> list[dict[str, Any]]:
    sent = [event for event in tab.events if event.get("method") == "Network.requestWillBeSent"]
    return [event for event in sent if not event["params"]["request"]["url"].startswith(("data:", "blob:"))]


def drag(
    tab: Browser, dx: int, dy: int, button: str = "left", modifiers: int = 0, at: tuple[float, float] = (200, 200)
) -> None:
    x, y = at
    mouse = {"button": button, "buttons": 1 if button == "left" else 2, "modifiers": modifiers}
    tab.send("Input.dispatchMouseEvent", type="mousePressed", x=x, y=y, clickCount=1, **mouse)
    for step in range(1, 5):
        tab.send("Input.dispatchMouseEvent", type="mouseMoved", x=x + dx * step / 4, y=y + dy * step / 4, **mouse)
    tab.send("Input.dispatchMouseEvent", type="mouseReleased", x=x + dx, y=y + dy, **mouse)


def picture(tab: Tab, pose: int, width: int, height: int) -> np.ndarray:
    text = tab.run(
        f"(async () => {{ viewer.setPose({pose}); const blob = await viewer.picture({width}, {height});"
        "const reader = new FileReader(); reader.readAsDataURL(blob);"
        "await new Promise((done) => (reader.onload = done)); return reader.result; })()"
    )
    data = base64.b64decode(text.partition(",")[2])
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"), np.float64)
