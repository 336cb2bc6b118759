"""Write Gaussians as `.glb` with `KHR_gaussian_splatting`: one node, one primitive, and a point cloud for other programs.

Each attribute has its own buffer view. Rotations are normalized shorts, off by at most 0.004 degrees; an opacity takes 4 bytes
whatever its type, since rows of attributes begin at multiples of 4. The extension allows only floats for SH.

With `--glb spz`, the buffer is a `.spz` (`io.gltf` has the source), and accessors without a buffer view say what it unpacks to.
CesiumJS takes buffer view 0 whatever the file says, and asks for a node with a matrix and for both extensions as required ones.
"""

import io
import json
import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, BinaryIO

import numpy as np

from flexgs_edge._version import __version__
from flexgs_edge.constants import SH_C0
from flexgs_edge.errors import InputError
from flexgs_edge.io.frames import LUF, RUB, in_frame
from flexgs_edge.io.gltf import EXTENSION, SPZ_EXTENSIONS
from flexgs_edge.io.gltf_container import BIN_CHUNK, COMPONENTS, JSON_CHUNK, MAGIC, WIDTHS
from flexgs_edge.io.reading import Writing
from flexgs_edge.io.spz import spz_source
from flexgs_edge.io.spz_writer import write_spz
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
    sizes = [attribute.row_bytes * source.count for attribute in attributes]
    starts = np.cumsum([0, *sizes]).tolist()
    record = _record(source, attributes, _bounds(source))
    record["bufferViews"] = [
        {"buffer": 0, "byteOffset": start, "byteLength": size, "target": _VERTICES}
        for start, size in zip(starts, sizes)
    ]
    for index, accessor in enumerate(record["accessors"]):
        accessor["bufferView"] = index
    at = _begin(file, source, record, starts[-1])
    for rows in source.chunks(_CHUNK_ROWS):
        planes = source.read(rows, list(FIELD))
        for start, attribute in zip(starts, attributes):
            file.seek(at + start + attribute.row_bytes * rows.start)
            file.write(attribute.pack(planes))


def write_glb_spz(file: BinaryIO, source: SceneSource, writing: Writing) -> None:
    """Write a scene with its values as a `.spz`; otherwise as `write_glb`."""
    packed = io.BytesIO()
    write_spz(packed, in_frame(in_frame(source, LUF), RUB), Writing(antialiased=writing.antialiased))
    data = packed.getvalue()
    position, colour, rotation, scale, _, _, *rest = _attributes(source.sh_degree)
    # The draft has no attributes for opacities and constant colours.
    attributes = [position, colour, replace(rotation, component=_FLOAT), scale, *rest]
    record = _record(source, attributes, _bounds(in_frame(in_frame(spz_source(data, source.name), RUB), LUF)))
    extensions = [EXTENSION, SPZ_EXTENSIONS[0]]
    record |= {"extensionsUsed": extensions, "extensionsRequired": extensions}
    record["meshes"][0]["primitives"][0]["extensions"][EXTENSION]["extensions"] = {SPZ_EXTENSIONS[0]: {"bufferView": 0}}
    record["bufferViews"] = [{"buffer": 0, "byteLength": len(data)}]
    record["nodes"] = [{"mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, *source.origin.tolist(), 1]}]
    _begin(file, source, record, len(data))
    file.write(data + b"\0" * (-len(data) % 4))


def _attributes(sh_degree: int) -> list[_Attribute]:
    """The attributes in the order of their bytes."""
    found = [
        _Attribute("POSITION", _FLOAT, "VEC3", lambda planes: planes["means"]),
        _Attribute("COLOR_0", _UNSIGNED_BYTE, "VEC4", _colours),
        _Attribute(f"{EXTENSION}:ROTATION", _SHORT, "VEC4", lambda planes: planes["quats"][[1, 2, 3, 0]]),
        _Attribute(f"{EXTENSION}:SCALE", _FLOAT, "VEC3", linear_scales),
        _Attribute(f"{EXTENSION}:OPACITY", _FLOAT, "SCALAR", plain_opacities),
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


def _record(source: SceneSource, attributes: list[_Attribute], bounds: dict[str, list[float]]) -> dict[str, Any]:
    """The JSON, without buffers and what lies where in them."""
    accessors: list[dict[str, Any]] = [
        {"componentType": attribute.component, "count": source.count, "type": attribute.type}
        | ({} if attribute.component == _FLOAT else {"normalized": True})
        for attribute in attributes
    ]
    accessors[0] |= bounds
    primitive = {
        "attributes": {attribute.name: index for index, attribute in enumerate(attributes)},
        "mode": _POINTS,
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    return {
        "asset": {"version": "2.0", "generator": f"flexgs-edge {__version__}"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0} | ({"translation": source.origin.tolist()} if np.any(source.origin) else {})],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
    }


def _begin(file: BinaryIO, source: SceneSource, record: dict[str, Any], length: int) -> int:
    """Write all but the buffer of `length` bytes; returns where it begins. Chunks are padded to multiples of 4 bytes."""
    text = json.dumps(record | {"buffers": [{"byteLength": length}]}, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    start, padded = 28 + len(text), length + -length % 4
    if start + padded > _LARGEST:
        raise InputError(
            f"{source.name}: {source.count} Gaussians need {start + padded} bytes as .glb, which holds {_LARGEST} at most; "
            "use --sh-degree, or write another format"
        )
    file.write(MAGIC + struct.pack("<4I", 2, start + padded, len(text), JSON_CHUNK) + text)
    file.write(struct.pack("<2I", padded, BIN_CHUNK))
    return start


def _bounds(source: SceneSource) -> dict[str, list[float]]:
    """The least and the largest position, which glTF demands."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for rows in source.chunks(_CHUNK_ROWS):
        means = source.read(rows, ["means"])["means"]
        low, high = np.minimum(low, means.min(axis=1)), np.maximum(high, means.max(axis=1))
    return {"min": low.tolist(), "max": high.tolist()}


def linear_scales(planes: Planes) -> np.ndarray:
    """[3, n] f64, standard deviations."""
    # Neither zero nor infinite, which a reader could not take back.
    limits = np.finfo(np.float32)
    return np.clip(_exp(planes["log_scales"]), limits.tiny, limits.max)


def plain_opacities(planes: Planes) -> np.ndarray:
    """[1, n] f64, 0 to 1."""
    return 1 / (1 + _exp(-planes["opacity_logits"]))


def _colours(planes: Planes) -> np.ndarray:
    """[4, n], what a viewer without splats shows: colours without SH, and opacities."""
    colours = np.clip(planes["sh_dc"].astype(np.float64) * SH_C0 + 0.5, 0, 1)
    return np.concatenate([colours, plain_opacities(planes)])


def _exp(values: np.ndarray) -> np.ndarray:
    """f64 exponentials of f32 values, by sums, products and powers of two only, so that all machines write the same bytes."""
    wide = np.clip(values.astype(np.float64), -700, 700)
    power = np.rint(wide / (_LN2_HIGH + _LN2_LOW))
    rest = (wide - power * _LN2_HIGH) - power * _LN2_LOW
    total: np.ndarray = np.ones_like(rest)
    for term in range(_TERMS, 0, -1):
        total = 1 + rest * total / term
    return np.ldexp(total, power.astype(np.int32))
