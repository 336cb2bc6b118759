"""Contents of a page besides the result: pictures, camera poses, and channels of the file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from flexgs_edge.goals.target import Target


@dataclass(frozen=True)
class Shot:
    """Pictures of one view, JPEG.

    `rank`, `of`: rank among the measured views, 0 for the worst, and the number of measured views. `width`, `height`:
    pixels of the pictures. Wider views were scaled down. `original`, `compressed`, `error`: render of the original,
    render of the decoded file, and the error map between them.
    """

    view: int  # index into the views of the record's quality
    camera: int  # index into the cameras of the rig
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
class Rig:
    """Camera poses in order of name, and some points of the scene."""

    names: tuple[str, ...]  # names of the V cameras
    centers: np.ndarray  # [V, 3] f64, positions in world coordinates
    rotations: np.ndarray  # [V, 3, 3] f64, world to camera (x right, y down, z forward)
    reach: np.ndarray  # [V, 2] f64, half the width and height of the visible area at distance 1
    held_out: frozenset[int]  # Indices of the held-out cameras. All others are training cameras.
    points: np.ndarray  # [P, 3] f64, positions of some Gaussians in world coordinates


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
    rig: Rig | None = None  # camera poses; `None` without cameras
    contents: dict[str, Any] | None = None  # JSON record of `info`; `None` for formats whose channels it does not know
    target: Target | None = None  # target that the search chart marks with a line
    live: Live | None = None  # live scenes
