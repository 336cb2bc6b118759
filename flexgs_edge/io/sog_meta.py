"""The `meta.json` of a SOG scene, versions 1 and 2, checked field by field."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from flexgs_edge.errors import FormatError, brief
from flexgs_edge.io.decoded import opacity_logits

LEVELS = 256  # Values of a byte
BANDS: dict[int, int] = {1: 3, 2: 8, 3: 15}  # SH coefficients above degree 0 of one colour channel, by SH degree
_MOST_COUNT = 2**31 - 1


@dataclass(frozen=True)
class SogMeta:
    """What `meta.json` says, with the values of bytes as tables: both versions then decode alike."""

    version: int  # 1 or 2
    count: int  # Gaussians
    antialiased: bool  # whether the model is drawn antialiased
    bounds: np.ndarray  # [2, 3] f64, lowest and highest positions in the log map
    scales: np.ndarray  # [3, 256] f64, log-scales of the bytes
    sh0: np.ndarray  # [4, 256] f64, SH coefficients of degree 0 of the bytes, and opacity logits
    sh: np.ndarray | None  # [256] f64, SH coefficients above degree 0 of the bytes; `None` if the scene has none
    sh_degree: int | None  # As the file states it. `None`: it follows from the width of the palette's picture.
    palette: int | None  # Entries of the palette. `None`: as many as its picture holds.
    # Names of the pictures: `means_l`, `means_u`, `quats`, `scales`, `sh0`, `centroids`, `labels`.
    files: dict[str, str]


class JsonObject:
    """An object of a JSON file, with its place for messages; every method raises `FormatError`.

    `place`: such as `scene.sog: meta.json`. `value`: must be an object. `path`: keys that lead to it, with a dot at the
    end.
    """

    def __init__(self, place: str, value: Any, path: str = "") -> None:
        self.place, self.path = place, path
        if not isinstance(value, dict):
            raise FormatError(f"{place}: {path.rstrip('.') or 'top level'}: expected an object, found {brief(value)}")
        self.value: dict[str, Any] = value

    def has(self, key: str) -> bool:
        """Whether the key exists and its value is not null."""
        return self.value.get(key) is not None

    def fail(self, key: str, expected: str) -> FormatError:
        """Make the error for a value that is missing or wrong."""
        found = brief(self.value[key]) if key in self.value else "no such field"
        return FormatError(f"{self.place}: {self.path}{key}: expected {expected}, found {found}")

    def inner(self, key: str) -> JsonObject:
        """An object within this one."""
        if key not in self.value:
            raise self.fail(key, "an object")
        return JsonObject(self.place, self.value[key], f"{self.path}{key}.")

    def integer(self, key: str, lowest: int, highest: int) -> int:
        """A whole number."""
        value = self.value.get(key)
        if isinstance(value, float) and value.is_integer():
            value = int(value)
        if type(value) is not int or not lowest <= value <= highest:
            raise self.fail(key, f"a whole number from {lowest} to {highest}")
        return value

    def numbers(self, key: str, least: int, most: int) -> np.ndarray:
        """A list of finite numbers as [n] f64."""
        expected = f"{least} finite numbers" if least == most else f"{least} to {most} finite numbers"
        value = self.value.get(key)
        if not isinstance(value, list) or not least <= len(value) <= most:
            raise self.fail(key, expected)
        numbers = [_finite(item) for item in value]
        if None in numbers:
            raise self.fail(key, expected)
        return np.array(numbers, np.float64)

    def name(self, key: str) -> str:
        """A text that is not empty."""
        value = self.value.get(key)
        if not _is_name(value):
            raise self.fail(key, "a file name")
        return str(value)

    def names(self, key: str, count: int | None = None) -> list[str]:
        """A list of at least `count` names, without further ones; or a whole list."""
        value = self.value.get(key)
        if not isinstance(value, list) or len(value) < (count or 1) or not all(map(_is_name, value[:count])):
            raise self.fail(key, "a list of file names" if count is None else f"{count} file name{'s' * (count > 1)}")
        return value[:count]


def parse_object(data: bytes, place: str) -> JsonObject:
    """The object that a JSON text holds.

    Raises `FormatError` if it is no JSON, or another value.
    """
    try:
        return JsonObject(place, json.loads(data))
    except json.JSONDecodeError as error:
        raise FormatError(
            f"{place}: not JSON: {error.msg} in line {error.lineno}, column {error.colno}; is it complete?"
        ) from error
    except FormatError:  # a ValueError too, and said already what is wrong
        raise
    except RecursionError:
        raise FormatError(f"{place}: not usable JSON: lists in lists of very many levels") from None
    except ValueError as error:  # also bytes that are no text, and numbers of absurd length
        raise FormatError(f"{place}: not JSON: {error}") from error


def parse_meta(data: bytes, place: str) -> SogMeta:
    """Check a `meta.json`.

    Raises `FormatError` if a field is missing or wrong, or the version is unknown.
    """
    top = parse_object(data, place)
    version = top.integer("version", 1, 2) if top.has("version") else 1
    means = top.inner("means")
    if version == 2:
        count = top.integer("count", 0, _MOST_COUNT)
    else:
        shape = means.value.get("shape")
        if not isinstance(shape, list) or not shape or type(shape[0]) is not int or not 0 <= shape[0] <= _MOST_COUNT:
            raise means.fail("shape", f"a list that begins with the count, 0 to {_MOST_COUNT}")
        count = shape[0]
    antialiased = top.value.get("antialias") or False
    if not isinstance(antialiased, bool):
        raise top.fail("antialias", "true or false")
    scales, sh0 = top.inner("scales"), top.inner("sh0")
    files = dict(zip(("means_l", "means_u"), means.names("files", 2)))
    files["quats"] = top.inner("quats").names("files", 1)[0]
    files["scales"], files["sh0"] = scales.names("files", 1)[0], sh0.names("files", 1)[0]
    if version == 2:
        scale_table = np.tile(_codebook(scales), (3, 1))
        colours = np.tile(_codebook(sh0), (3, 1))
        sh0_table = np.concatenate([colours, opacity_logits(np.arange(LEVELS) / 255)[None]])
    else:
        scale_table, sh0_table = _ramps(scales, 3), _ramps(sh0, 4)
    table, degree, palette = None, None, None
    if top.has("shN"):
        sh = top.inner("shN")
        degree = sh.integer("bands", 0, max(BANDS)) if sh.has("bands") else None
        if degree != 0:
            palette = sh.integer("count", 1, 65536) if sh.has("count") else None
            table = _codebook(sh) if version == 2 else _ramp(sh)
            files.update(zip(("centroids", "labels"), sh.names("files", 2)))
    return SogMeta(
        version=version,
        count=count,
        antialiased=antialiased,
        bounds=np.stack([means.numbers("mins", 3, 3), means.numbers("maxs", 3, 3)]),
        scales=scale_table,
        sh0=sh0_table,
        sh=table,
        sh_degree=degree if table is not None else 0,
        palette=palette,
        files=files,
    )


def _codebook(part: JsonObject) -> np.ndarray:
    """[256] f64; entries beyond the end of a shorter list are NaN, which `check_scene` reports with their rows."""
    value = part.value.get("codebook")
    if isinstance(value, list) and len(value) == LEVELS and value[0] is None and None not in value[1:]:
        # An early writer left the first entry out. PlayCanvas continues the list downwards by its mean step.
        rest = JsonObject(part.place, {"codebook": value[1:]}, part.path).numbers("codebook", LEVELS - 1, LEVELS - 1)
        return np.concatenate([[rest[0] + (rest[0] - rest[-1]) / 255], rest])
    numbers = part.numbers("codebook", 1, LEVELS)
    return np.concatenate([numbers, np.full(LEVELS - len(numbers), np.nan)])


def _ramps(part: JsonObject, width: int) -> np.ndarray:
    """[width, 256] f64, equal steps between the ends of each channel."""
    return _steps(part.numbers("mins", width, width)[:, None], part.numbers("maxs", width, width)[:, None])


def _ramp(part: JsonObject) -> np.ndarray:
    """[256] f64, equal steps between two numbers."""
    ends = [_finite(part.value.get(key)) for key in ("mins", "maxs")]
    for key, end in zip(("mins", "maxs"), ends):
        if end is None:
            raise part.fail(key, "a finite number")
    return _steps(np.float64(ends[0]), np.float64(ends[1]))


def _steps(lowest: np.ndarray | np.float64, highest: np.ndarray | np.float64) -> np.ndarray:
    shares = np.arange(LEVELS) / 255
    return np.asarray(lowest * (1 - shares) + highest * shares)


def _finite(value: Any) -> float | None:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def _is_name(value: Any) -> bool:
    return isinstance(value, str) and bool(value)
