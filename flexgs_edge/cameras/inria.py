"""INRIA's cameras.json: a list of poses, camera to world, as the reference training program writes it."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.errors import FormatError, InputError

ROTATION_TOLERANCE = 1e-3
"""Largest entry of |R R^T - 1|: files keep 6 digits and more, a scaled or sheared matrix is off by far more."""
MAX_SIDE = 65535
"""Pixels: more is a damaged file (JPEG ends here too)."""


def read_inria(path: str | os.PathLike[str]) -> list[Camera]:
    """Read INRIA's cameras.json, in the file's order.

    The file has no principal point: it is the middle of the image, (W - 1) / 2 with integer pixel centres.

    Raises
    ------
    InputError
        When the file cannot be read.
    FormatError
        When it is not JSON, not a list, empty, or an entry is wrong; names file, entry and field.
    """
    path = Path(path)
    entries = _load(path)
    if not isinstance(entries, list):
        hint = "; this looks like a NeRF transforms.json" if isinstance(entries, dict) and "frames" in entries else ""
        raise FormatError(f"{path}: expected a JSON list of cameras, found {_kind(entries)}{hint}")
    if not entries:
        raise FormatError(f"{path}: the list of cameras is empty")
    cameras = [_Entry(path, index, entry).camera() for index, entry in enumerate(entries)]
    first: dict[str, int] = {}
    for index, camera in enumerate(cameras):
        if camera.name in first:
            raise FormatError(
                f"{path}: cameras {first[camera.name]} and {index}: img_name {camera.name!r} appears twice; "
                "names must differ"
            )
        first[camera.name] = index
    return cameras


def _load(path: Path) -> Any:
    try:
        return json.loads(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot read the cameras ({error.strerror})") from error
    except json.JSONDecodeError as error:
        raise FormatError(f"{path}: not JSON: {error.msg} in line {error.lineno}, column {error.colno}") from error
    except (UnicodeDecodeError, RecursionError, ValueError) as error:
        raise FormatError(f"{path}: not JSON: {error}") from error


def _kind(value: Any) -> str:
    names = {dict: "an object", list: "a list", str: "a string", bool: "a boolean", type(None): "null"}
    return names.get(type(value), "a number")


class _Entry:
    """One camera of the file, with its place for messages."""

    def __init__(self, path: Path, index: int, entry: Any) -> None:
        self.place = f"{path}: camera {index}"
        if not isinstance(entry, dict):
            raise FormatError(f"{self.place}: expected an object, found {_kind(entry)}")
        self.entry = entry

    def camera(self) -> Camera:
        name = self._name()
        width, height = self._side("width"), self._side("height")
        fx, fy = self._focal("fx"), self._focal("fy")
        position = self._array("position", (3,))
        rotation = self._rotation().T
        translation = -rotation @ position
        return Camera(name, width, height, rotation, translation, fx, fy, (width - 1) / 2, (height - 1) / 2)

    def _get(self, key: str) -> Any:
        if key not in self.entry:
            raise FormatError(f"{self.place}: missing key {key!r}; found {', '.join(map(repr, self.entry)) or 'none'}")
        return self.entry[key]

    def _fail(self, key: str, expected: str, found: str) -> FormatError:
        return FormatError(f"{self.place}: {key}: expected {expected}, found {found}")

    def _name(self) -> str:
        name = self._get("img_name")
        if not isinstance(name, str) or not name.strip():
            raise self._fail("img_name", "a name", repr(name))
        return name

    def _number(self, key: str, expected: str) -> float:
        value = self._get(key)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise self._fail(key, expected, _kind(value))
        try:
            return float(value)
        except OverflowError:
            raise self._fail(key, expected, "a number beyond float64") from None

    def _side(self, key: str) -> int:
        expected = f"a whole number of pixels from 1 to {MAX_SIDE}"
        value = self._number(key, expected)
        if not 1 <= value <= MAX_SIDE or value != int(value):
            raise self._fail(key, expected, f"{value:g}")
        return int(value)

    def _focal(self, key: str) -> float:
        value = self._number(key, "a focal length in pixels")
        if not (math.isfinite(value) and value > 0):
            raise self._fail(key, "a focal length above 0 pixels", f"{value:g}")
        return value

    def _array(self, key: str, shape: tuple[int, ...]) -> np.ndarray:
        expected = " x ".join(map(str, shape)) + " finite numbers"
        value = self._get(key)
        if _shape(value) != shape:
            raise self._fail(key, expected, repr(value)[:80])
        leaves = np.array(value, dtype=object)
        if not all(isinstance(leaf, (int, float)) and not isinstance(leaf, bool) for leaf in leaves.flat):
            raise self._fail(key, expected, repr(value)[:80])
        try:
            array = leaves.astype(np.float64)
        except OverflowError:
            raise self._fail(key, expected, "a number beyond float64") from None
        if not np.all(np.isfinite(array)):
            raise self._fail(key, expected, f"{array.tolist()}")
        return array

    def _rotation(self) -> np.ndarray:
        rotation = self._array("rotation", (3, 3))
        error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
        if not error <= ROTATION_TOLERANCE:
            raise self._fail(
                "rotation", f"an orthonormal matrix (within {ROTATION_TOLERANCE})", f"one off by {error:.3g}"
            )
        if np.linalg.det(rotation) < 0:
            raise self._fail("rotation", "a rotation (determinant 1)", "a reflection (determinant -1)")
        return rotation


def _shape(value: Any) -> tuple[int, ...] | None:
    """Shape of nested lists, None if they are ragged (which NumPy would raise on)."""
    if not isinstance(value, list):
        return ()
    shapes = {_shape(item) for item in value}
    inner = shapes.pop() if len(shapes) == 1 else None
    return None if inner is None else (len(value), *inner)
