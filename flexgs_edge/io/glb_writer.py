"""Write Gaussians as `.glb` with `KHR_gaussian_splatting`: one node, one primitive, and a point cloud for other programs.

Each attribute has its own buffer view. Rotations are normalized shorts, off by at most 0.004 degrees; an opacity takes 4 bytes
whatever its type, since rows of attributes begin at multiples of 4. The extension allows only floats for SH.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np

from flexgs_edge._version import __version__
from flexgs_edge.constants import SH_C0
from flexgs_edge.errors import InputError
from flexgs_edge.io.gltf import EXTENSION
from flexgs_edge.io.gltf_container import BIN_CHUNK, COMPONENTS, JSON_CHUNK, MAGIC, WIDTHS
from flexgs_edge.io.reading import Writing
from flexgs_edge.scene.fields import FIELD, sh_rest_count
from flexgs_edge.scene.source import Planes, SceneSource

_CHUNK_ROWS = 32768
_LARGEST = 2**32 - 1  # Most bytes of a `.glb`: its header has 32 bits for them
_UNSIGNED_BYTE, _SHORT, _FLOAT = 5121, 5122, 5126
_POINTS, _VERTICES = 0, 34962
_LN2_HIGH, _LN2_LOW = 0.6931471803691238, 1.9082149292705877e-10
"""Natural log of 2 in two parts; the first has so few bits that its multiples are exact."""
_TERMS = 14


@dataclass(frozen=True)
class _Attribute:
    """An attribute of the primitive, and how its values are made: [width, n] f64 from a chunk of the scene."""

    name: str
    component: int
    type: str
    make: Callable[[Planes], np.ndarray]

    @property
    def row_bytes(self) -> int:
        return np.dtype(COMPONENTS[self.component]).itemsize * WIDTHS[self.type]

    def pack(self, planes: Planes) -> bytes:
        """The rows as they are stored: whole numbers are normalized and rounded to the nearest."""
        kind = np.dtype(COMPONENTS[self.component])
        values = self.make(planes)
        if kind.kind != "f":
            values = np.rint(values * np.iinfo(kind).max)
        return np.ascontiguousarray(values.T, kind).tobytes()


def write_glb(file: BinaryIO, source: SceneSource, writing: Writing) -> None:
    """Write a scene. See `io.formats.Format.writer` for the arguments.

    Raises `InputError` if the file would have more than 4 GiB, the most that a `.glb` can have.
    """
    attributes = _attributes(source.sh_degree)
    header = _header(source, attributes)
    length = sum(attribute.row_bytes for attribute in attributes) * source.count
    total = 28 + len(header) + length
    if total > _LARGEST:
        raise InputError(
            f"{source.name}: {source.count} Gaussians need {total} bytes as .glb, which holds {_LARGEST} at most; "
            "use --sh-degree, or write another format"
        )
    file.write(MAGIC + struct.pack("<4I", 2, total, len(header), JSON_CHUNK) + header)
    file.write(struct.pack("<2I", length, BIN_CHUNK))
    start = 28 + len(header)
    for rows in source.chunks(_CHUNK_ROWS):
        planes, at = source.read(rows, list(FIELD)), start
        for attribute in attributes:
            file.seek(at + attribute.row_bytes * rows.start)
            file.write(attribute.pack(planes))
            at += attribute.row_bytes * source.count


def _attributes(sh_degree: int) -> list[_Attribute]:
    """The attributes in the order of their bytes."""
    found = [
        _Attribute("POSITION", _FLOAT, "VEC3", lambda planes: planes["means"]),
        _Attribute("COLOR_0", _UNSIGNED_BYTE, "VEC4", _colours),
        _Attribute(f"{EXTENSION}:ROTATION", _SHORT, "VEC4", lambda planes: planes["quats"][[1, 2, 3, 0]]),
        _Attribute(f"{EXTENSION}:SCALE", _FLOAT, "VEC3", _scales),
        _Attribute(f"{EXTENSION}:OPACITY", _FLOAT, "SCALAR", _opacities),
        _Attribute(f"{EXTENSION}:SH_DEGREE_0_COEF_0", _FLOAT, "VEC3", lambda planes: planes["sh_dc"]),
    ]
    for degree in range(1, sh_degree + 1):
        for number in range(2 * degree + 1):
            name = f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{number}"
            found.append(_Attribute(name, _FLOAT, "VEC3", _Coefficient(sh_rest_count(degree - 1) + number)))
    return found


@dataclass(frozen=True)
class _Coefficient:
    """Red, green and blue of one SH coefficient."""

    index: int

    def __call__(self, planes: Planes) -> np.ndarray:
        rest = planes["sh_rest"]
        return rest[self.index :: len(rest) // 3]


def _header(source: SceneSource, attributes: list[_Attribute]) -> bytes:
    """The JSON, padded to a multiple of 4 bytes."""
    views, accessors, start = list[dict[str, Any]](), list[dict[str, Any]](), 0
    for index, attribute in enumerate(attributes):
        length = attribute.row_bytes * source.count
        views.append({"buffer": 0, "byteOffset": start, "byteLength": length, "target": _VERTICES})
        accessor = {
            "bufferView": index,
            "componentType": attribute.component,
            "count": source.count,
            "type": attribute.type,
        }
        if attribute.component != _FLOAT:
            accessor["normalized"] = True
        accessors.append(accessor)
        start += length
    accessors[0] |= _bounds(source)
    primitive = {
        "attributes": {attribute.name: index for index, attribute in enumerate(attributes)},
        "mode": _POINTS,
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    record = {
        "asset": {"version": "2.0", "generator": f"flexgs-edge {__version__}"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0} | ({"translation": source.origin.tolist()} if np.any(source.origin) else {})],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": start}],
    }
    text = json.dumps(record, separators=(",", ":")).encode()
    return text + b" " * (-len(text) % 4)


def _bounds(source: SceneSource) -> dict[str, list[float]]:
    """The least and the largest position, which glTF demands."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for rows in source.chunks(_CHUNK_ROWS):
        means = source.read(rows, ["means"])["means"]
        low, high = np.minimum(low, means.min(axis=1)), np.maximum(high, means.max(axis=1))
    return {"min": low.tolist(), "max": high.tolist()}


def _scales(planes: Planes) -> np.ndarray:
    # Neither zero nor infinite, which a reader could not take back.
    limits = np.finfo(np.float32)
    found: np.ndarray = np.clip(_exp(planes["log_scales"]), limits.tiny, limits.max)
    return found


def _opacities(planes: Planes) -> np.ndarray:
    found: np.ndarray = 1 / (1 + _exp(-planes["opacity_logits"]))
    return found


def _colours(planes: Planes) -> np.ndarray:
    """[4, n], what a viewer without splats shows: colours without SH, and opacities."""
    colours = np.clip(planes["sh_dc"].astype(np.float64) * SH_C0 + 0.5, 0, 1)
    found: np.ndarray = np.concatenate([colours, _opacities(planes)])
    return found


def _exp(values: np.ndarray) -> np.ndarray:
    """f64 exponentials of f32 values, by sums, products and powers of two only, so that all machines write the same bytes."""
    wide = np.clip(values.astype(np.float64), -700, 700)
    power = np.rint(wide / (_LN2_HIGH + _LN2_LOW))
    rest = (wide - power * _LN2_HIGH) - power * _LN2_LOW
    total: np.ndarray = np.ones_like(rest)
    for term in range(_TERMS, 0, -1):
        total = 1 + rest * total / term
    result: np.ndarray = np.ldexp(total, power.astype(np.int32))
    return result
