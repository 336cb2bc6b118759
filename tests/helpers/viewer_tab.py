"""What the tests of drawing pages ask a browser for."""

from __future__ import annotations

import json
import time
from typing import Any

import numpy as np

from browser import Browser

SOFTWARE = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")


def until(tab: Browser, condition: str) -> None:
    for _ in range(600):
        if tab.run(f"Boolean({condition})"):
            return
        time.sleep(0.1)
    raise AssertionError(f"not within a minute: {condition}; {tab.run('document.body.innerText')!r}, {faults(tab)}")


def faults(tab: Browser) -> list[str]:
    """What went wrong in the page: exceptions, refused requests, broken policies."""
    names = ("Runtime.exceptionThrown", "Log.entryAdded", "Network.loadingFailed")
    found = [event for event in tab.events if event.get("method") in names]
    # A request that the page itself has given up is none.
    return [json.dumps(event)[:500] for event in found if not event["params"].get("canceled")]


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
