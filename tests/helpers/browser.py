"""Headless Chromium over DevTools pipes: what the tests of pages need, without a driver program or a port."""

from __future__ import annotations

import base64
import fcntl
import json
import os
import select
import shutil
import subprocess
import sys
import time
from pathlib import Path
from types import TracebackType
from typing import Any

NAMES = ("chromium", "google-chrome")
FLAGS: tuple[str, ...] = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
    "--remote-debugging-pipe",
)
# The browser reads commands from descriptor 3 and writes to 4; pytest may have files of its own at those numbers.
LAUNCHER = (
    "import os, sys; os.dup2(int(sys.argv[1]), 3); os.dup2(int(sys.argv[2]), 4); os.execvp(sys.argv[3], sys.argv[3:])"
)
PATIENCE = 180.0


def find_browser() -> str | None:
    """The browser's program, if there is one; not a snap, which sees neither our files nor our pipes."""
    found = (shutil.which(name) for name in NAMES)
    return next((path for path in found if path and os.path.basename(os.path.realpath(path)) != "snap"), None)


class Browser:
    """One page of a browser; `events` holds all that it told, in order."""

    def __init__(self, program: str, profile: Path) -> None:
        self.events: list[dict[str, Any]] = []
        self._rest, self._last, self._session = b"", 0, ""
        to_read, self._write = os.pipe()
        self._read, to_write = os.pipe()
        ours = [fcntl.fcntl(number, fcntl.F_DUPFD, 10) for number in (to_read, to_write)]
        command = [sys.executable, "-c", LAUNCHER, *map(str, ours), program, *FLAGS, f"--user-data-dir={profile}"]
        self._process = subprocess.Popen(command, pass_fds=ours, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        for number in (to_read, to_write, *ours):
            os.close(number)
        target = self.send("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")

    def __enter__(self) -> Browser:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.close(self._write)  # the browser ends with its pipe
        try:
            self._process.wait(20)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._read)

    def send(self, method: str, **params: Any) -> dict[str, Any]:
        """A command and its answer."""
        self._last += 1
        message: dict[str, Any] = {"id": self._last, "method": method, "params": params}
        if self._session:
            message["sessionId"] = self._session
        data = json.dumps(message).encode() + b"\0"
        while data:
            data = data[os.write(self._write, data) :]
        while True:
            answer = self._next(time.monotonic() + PATIENCE)
            if answer.get("id") == self._last:
                assert "error" not in answer, f"{method}: {answer['error']}"
                result: dict[str, Any] = answer["result"]
                return result
            self.events.append(answer)

    def wait(self, method: str) -> dict[str, Any]:
        """The next event of this name."""
        until = time.monotonic() + PATIENCE
        while True:
            event = self._next(until)
            self.events.append(event)
            if event.get("method") == method:
                return event

    def _next(self, until: float) -> dict[str, Any]:
        while b"\0" not in self._rest:
            ready, _, _ = select.select([self._read], [], [], max(until - time.monotonic(), 0.0))
            data = os.read(self._read, 1 << 16) if ready else b""
            assert data, "the browser has ended" if ready else f"the browser said nothing for {PATIENCE:g} s"
            self._rest += data
        line, _, self._rest = self._rest.partition(b"\0")
        message: dict[str, Any] = json.loads(line)
        return message

    def open(self, page: Path, width: int, height: int = 800, dark: bool = False, script: bool = True) -> None:
        """Load a page on a screen of this size."""
        self.events.clear()
        self.send(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 600
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.send("Emulation.setEmulatedMedia", features=[scheme])
        self.send("Emulation.setScriptExecutionDisabled", value=not script)
        self.send("Page.navigate", url=page.as_uri())
        self.wait("Page.loadEventFired")

    def run(self, expression: str) -> Any:
        """The value of a JavaScript expression in the page."""
        answer = self.send("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def press(self, key: str, code: int) -> None:
        """A key, as the user presses it."""
        for kind in ("keyDown", "keyUp"):
            self.send("Input.dispatchKeyEvent", type=kind, key=key, code=key, windowsVirtualKeyCode=code)

    def picture(self, selector: str = "", full: bool = False) -> bytes:
        """PNG of the screen, of a whole page, or of an element."""
        clip = {}
        if selector:
            box = self.run(
                f"(b => [b.x + scrollX, b.y + scrollY, b.width, b.height])"
                f"(document.querySelector({selector!r}).getBoundingClientRect())"
            )
            clip = {"clip": dict(zip(("x", "y", "width", "height", "scale"), [*box, 1]))}
        answer = self.send("Page.captureScreenshot", format="png", captureBeyondViewport=full or bool(selector), **clip)
        return base64.b64decode(answer["data"])
