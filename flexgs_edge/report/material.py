"""Contents of a page besides the result: pictures, live scenes, and channels of the file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from flexgs_edge.goals.target import Target

ERROR_SCALE = 0.1
"""Differences from this share of the full range up get the brightest colour. All maps use the same scale, so that two pages can
be compared. At a fidelity of 40 dB a typical difference is a tenth of it, and half of it at edges."""
FLIP_SCALE = 0.5
"""FLIP from this value up gets the brightest colour. At a drop of 1 dB a typical pixel has a tenth to a fifth of it, and one in a
hundred 0.15 to 0.3."""
# Brightness rises evenly, so that the map can also be read in grey.
_STOPS = ((8, 6, 20), (74, 24, 110), (176, 50, 92), (240, 120, 40), (255, 206, 90), (255, 252, 232))


@dataclass(frozen=True)
class Shot:
    """Pictures of one view, JPEG.

    `rank`, `of`: rank among the measured views, 0 for the worst, and the number of measured views. `width`, `height`:
    pixels of the pictures. Wider views were scaled down. `original`, `compressed`, `error`: render of the original,
    render of the decoded file, and the error map between them.
    """

    view: int  # index into the views of the record's quality
    camera: int  # index into all cameras of the run
    rank: int
    of: int
    width: int
    height: int
    original: bytes
    compressed: bytes
    error: bytes
    flip: bytes  # map of FLIP between both renders
    photo: bytes | None = None  # the photo of this view, if there is one

    @property
    def place(self) -> str:
        """Describe the rank in words.

        >>> Shot(0, 0, 0, 5, 1, 1, b"", b"", b"", b"").place, Shot(0, 0, 1, 5, 1, 1, b"", b"", b"", b"").place
        ('Worst view', 'View 2 of 5 from the worst')
        """
        if self.of == 1:
            return "The only view"
        special = {self.of - 1: "Best view", (self.of - 1) // 2: "Median view", 0: "Worst view"}
        return special.get(self.rank, f"View {self.rank + 1} of {self.of} from the worst")


@dataclass(frozen=True)
class Live:
    """Scenes that a page draws while it is looked at."""

    script: str  # draws them
    config: dict[str, Any]  # cameras, the first of them, and how the scenes are drawn
    compressed: bytes | None  # the `.fgs` that was made; `None` if it is too large
    original: bytes | None  # the original as a `.fgs`
    note: str  # why a scene is not there


@dataclass(frozen=True)
class Material:
    """Contents of a page besides the result."""

    shots: tuple[Shot, ...] = ()  # pictures, worst view first
    contents: dict[str, Any] | None = None  # JSON record of `info`; `None` for formats whose channels it does not know
    target: Target | None = None  # target that the search chart marks with a line
    live: Live | None = None  # live scenes


def ramp() -> np.ndarray:
    """Colours of 256 even steps from no error to the largest, [256, 3] u8."""
    at = np.linspace(0, len(_STOPS) - 1, 256)
    stops = np.array(_STOPS, np.float64).T
    return np.stack([np.rint(np.interp(at, range(len(_STOPS)), channel)) for channel in stops], axis=1).astype(np.uint8)


def css_ramp() -> str:
    """The colours as a CSS gradient."""
    return "linear-gradient(90deg," + ",".join(f"rgb({r} {g} {b})" for r, g, b in _STOPS) + ")"


def error_map(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Largest difference over the channels of two [H, W, 3] images, divided by `ERROR_SCALE`: [H, W] f32 from 0 to 1."""
    difference = np.abs(np.clip(image, 0.0, 1.0) - np.clip(reference, 0.0, 1.0)).max(axis=2)
    shares: np.ndarray = np.minimum(difference / np.float32(ERROR_SCALE), np.float32(1.0))
    return shares
