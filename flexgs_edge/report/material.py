"""What a page shows beside the result record: pictures, where cameras stood, what the file holds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from flexgs_edge.goals.target import Target


@dataclass(frozen=True)
class Shot:
    """Pictures of one view, JPEG.

    Parameters
    ----------
    view : int
        Index into the views of the record's quality.
    camera : int
        Index into the cameras of the rig.
    rank, of : int
        Place from the worst (0) among the views that were measured, and their number.
    width, height : int
        Pixels of the pictures (views that are wider were scaled down).
    original, compressed, error : bytes
        Render of the original, of the decoded file, and the error map between them.
    photo : bytes or None
        The photo of this view.
    """

    view: int
    camera: int
    rank: int
    of: int
    width: int
    height: int
    original: bytes
    compressed: bytes
    error: bytes
    photo: bytes | None = None

    @property
    def place(self) -> str:
        """The rank in words.

        >>> Shot(0, 0, 0, 5, 1, 1, b"", b"", b"").place, Shot(0, 0, 1, 5, 1, 1, b"", b"", b"").place
        ('Worst view', 'View 2 of 5 from the worst')
        """
        if self.of == 1:
            return "The only view"
        special = {self.of - 1: "Best view", (self.of - 1) // 2: "Median view", 0: "Worst view"}
        return special.get(self.rank, f"View {self.rank + 1} of {self.of} from the worst")


@dataclass(frozen=True)
class Rig:
    """Where cameras stood, in order of name.

    Parameters
    ----------
    names : tuple of str
    centers : np.ndarray
        [V, 3] f64, world.
    rotations : np.ndarray
        [V, 3, 3] f64, world to camera (x right, y down, z forward).
    reach : np.ndarray
        [V, 2] f64, half the width and height of what is seen at distance 1.
    held_out : frozenset of int
        The other views are for training.
    points : np.ndarray
        [P, 3] f64, world: positions of some Gaussians of the scene.
    """

    names: tuple[str, ...]
    centers: np.ndarray
    rotations: np.ndarray
    reach: np.ndarray
    held_out: frozenset[int]
    points: np.ndarray


@dataclass(frozen=True)
class Material:
    """Everything beside the record.

    Parameters
    ----------
    shots : tuple of Shot
        Worst view first.
    rig : Rig or None
        `None` without cameras.
    contents : dict or None
        What `info` found in the file (`None` where it knows no channels).
    target : Target or None
        Where the line of the search's chart stands.
    """

    shots: tuple[Shot, ...] = ()
    rig: Rig | None = None
    contents: dict[str, Any] | None = None
    target: Target | None = None
