"""Firefox over Marionette, its own protocol for tests: JSON over a local socket, without a driver program."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import time
from pathlib import Path
from types import TracebackType
from typing import Any

NAMES = ("firefox-esr", "firefox")
PREFERENCES: dict[str, str | int | bool] = {
    "marionette.port": 0,  # any free one
    "webgl.force-enabled": True,  # also in software
    "app.update.disabledForTesting": True,
    "browser.shell.checkDefaultBrowser": False,
    "datareporting.policy.dataSubmissionEnabled": False,
    "toolkit.telemetry.enabled": False,
    "network.captive-portal-service.enabled": False,
    "network.connectivity-service.enabled": False,
    "browser.safebrowsing.malware.enabled": False,
    "browser.safebrowsing.phishing.enabled": False,
    "services.settings.server": "data:,none",
    "extensions.getAddons.cache.enabled": False,
}
PATIENCE = 180.0


def find_firefox() -> str | None:
    """The browser's program, if there is one; not a snap, which cannot read our profile."""
    found = (shutil.which(name) for name in NAMES)
    return next((path for path in found if path and os.path.basename(os.path.realpath(path)) != "snap"), None)


def find_screen() -> str | None:
    """The program of a screen in memory. Headless, Firefox has no WebGL2 without a graphics card."""
    return shutil.which("Xvfb")


class Firefox:
    """One page of a browser on a screen of its own; `events` stays empty, as Marionette tells of none."""

    def __init__(self, program: str, screen: str, profile: Path) -> None:
        self.events: list[dict[str, Any]] = []
        lines = [f"user_pref({json.dumps(name)}, {json.dumps(value)});\n" for name, value in PREFERENCES.items()]
        (profile / "user.js").write_text("".join(lines))
        told, tells = os.pipe()
        silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self._screen = subprocess.Popen(
            [screen, "-displayfd", str(tells), "-screen", "0", "1200x900x24", "-nolisten", "tcp"],
            pass_fds=[tells],
            **silent,
        )
        os.close(tells)
        with os.fdopen(told) as number:
            display = f":{number.readline().strip()}"
        command = [program, "--no-remote", "--marionette", "--profile", str(profile)]
        environment = {**os.environ, "DISPLAY": display, "HOME": str(profile), "MOZ_DISABLE_CONTENT_SANDBOX": "1"}
        self._process = subprocess.Popen(command, env=environment, **silent)
        self._rest, self._last = b"", 0
        self._socket = socket.create_connection(("127.0.0.1", self._port(profile)), PATIENCE)
        self._message()  # a greeting
        self.send("WebDriver:NewSession", capabilities={"alwaysMatch": {"unhandledPromptBehavior": "ignore"}})
        self.send("WebDriver:SetTimeouts", script=1000 * PATIENCE)

    def _port(self, profile: Path) -> int:
        until, place = time.monotonic() + PATIENCE, profile / "MarionetteActivePort"
        while time.monotonic() < until and self._process.poll() is None:
            if place.is_file() and (text := place.read_text().strip()):
                return int(text)
            time.sleep(0.05)
        self._process.kill()
        raise AssertionError(f"Firefox does not start: exit code {self._process.wait()}")

    def __enter__(self) -> Firefox:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._socket.close()
        for process in (self._process, self._screen):
            process.terminate()
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def send(self, command: str, **params: Any) -> Any:
        """A command and its answer."""
        self._last += 1
        data = json.dumps([0, self._last, command, params]).encode()
        self._socket.sendall(b"%d:%s" % (len(data), data))
        _, number, error, result = self._message()
        assert number == self._last and error is None, f"{command}: {error}"
        return result

    def _message(self) -> Any:
        """The next message: its length, a colon, JSON."""
        while b":" not in self._rest:
            self._rest += self._more()
        length, _, self._rest = self._rest.partition(b":")
        while len(self._rest) < int(length):
            self._rest += self._more()
        data, self._rest = self._rest[: int(length)], self._rest[int(length) :]
        return json.loads(data)

    def _more(self) -> bytes:
        data = self._socket.recv(1 << 16)
        assert data, "the browser has ended"
        return data

    def open(self, address: str, width: int = 480, height: int = 360) -> None:
        """Load a page in a window whose page has this size."""
        self.send("WebDriver:Navigate", url=address)
        rect = self.send("WebDriver:GetWindowRect")
        inner = self.run("[innerWidth, innerHeight]")
        self.send(
            "WebDriver:SetWindowRect", width=rect["width"] + width - inner[0], height=rect["height"] + height - inner[1]
        )

    def run(self, expression: str) -> Any:
        """The value of a JavaScript expression in the page; promises are waited for."""
        script = (
            f"const done = arguments[arguments.length - 1]; (async () => ({expression}))()"
            ".then((value) => done([value ?? null, null]), (error) => done([null, String(error)]));"
        )
        answer = self.send("WebDriver:ExecuteAsyncScript", script=script, args=[], sandbox=None)
        value, error = answer["value"]
        assert error is None, f"{expression}: {error}"
        return value

    def act(self, *sources: dict[str, Any]) -> None:
        """Input as a user gives it: WebDriver's action sequences."""
        self.send("WebDriver:PerformActions", actions=list(sources))
        self.send("WebDriver:ReleaseActions")
