"""Cameras: poses and intrinsics, their files, and the photos that go with them."""

from __future__ import annotations

import os
from pathlib import Path

from flexgs_edge.cameras.camera import Camera, limit_width, split_views
from flexgs_edge.cameras.inria import read_inria
from flexgs_edge.cameras.photos import Photos
from flexgs_edge.errors import InputError

SUPPORTED = "INRIA's cameras.json (any .json file with a list of cameras), or a folder that holds one"

__all__ = ["Camera", "Photos", "limit_width", "read_cameras", "read_inria", "split_views"]


def read_cameras(path: str | os.PathLike[str]) -> list[Camera]:
    """Read cameras from a file or folder, sorted by name.

    Parameters
    ----------
    path : path
        INRIA's cameras.json, or a folder that holds one.

    Raises
    ------
    InputError
        When the path is missing or of an unknown kind; `FormatError` when the file breaks its format.
    """
    place = Path(path)
    if place.is_dir():
        place = place / "cameras.json"
        if not place.is_file():
            raise InputError(f"{path}: no cameras.json in this folder; supported: {SUPPORTED}")
    if not place.exists():
        raise InputError(f"{path}: no such camera file; supported: {SUPPORTED}")
    if place.suffix.lower() != ".json":
        raise InputError(f"{path}: unknown kind of camera file; supported: {SUPPORTED}")
    return sorted(read_inria(place), key=lambda camera: camera.name)
