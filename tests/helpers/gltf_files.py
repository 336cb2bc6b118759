"""Builds small glTF files from arrays, with one buffer, one accessor for each array and one node for each mesh; reads them."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge.io.gltf import read_gltf
from flexgs_edge.io.reading import AS_WRITTEN
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import Planes, SceneSource

EXTENSION = "KHR_gaussian_splatting"
TYPES = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}


def splat_arrays(count: int = 3, degree: int = 0, seed: int = 0) -> dict[str, np.ndarray]:
    """Attributes of a splat primitive, [count, width] f32, as the ratified extension has them."""
    rng = np.random.default_rng([seed, count, degree])
    quats = rng.normal(size=(count, 4))
    arrays = {
        "POSITION": rng.normal(size=(count, 3)),
        "ROTATION": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "SCALE": np.exp(rng.normal(-2, 0.7, (count, 3))),
        "OPACITY": rng.uniform(0.1, 0.9, (count, 1)),
        "SH_DEGREE_0_COEF_0": rng.normal(size=(count, 3)),
    }
    for band in range(1, degree + 1):
        for number in range(2 * band + 1):
            arrays[f"SH_DEGREE_{band}_COEF_{number}"] = rng.normal(0, 0.3, (count, 3))
    return {name: values.astype(np.float32) for name, values in arrays.items()}


class GltfBuilder:
    """A file in the making; `record` is its JSON and `data` its buffer, free to be changed."""

    def __init__(self) -> None:
        self.data = b""
        self.record: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "extensionsUsed": [EXTENSION],
            "scene": 0,
            "scenes": [{"nodes": []}],
            "nodes": [],
            "meshes": [],
            "accessors": [],
            "bufferViews": [],
        }

    def view(self, data: bytes, **more: Any) -> int:
        """Append bytes as a buffer view."""
        self.data += b"\0" * (-len(self.data) % 4)
        self.record["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data), **more})
        self.data += data
        return len(self.record["bufferViews"]) - 1

    def accessor(self, values: np.ndarray, stride: int = 0, **more: Any) -> int:
        """Append an array [n, width] as an accessor, each row padded to `stride` bytes."""
        rows = values.reshape(len(values), values.shape[1])
        kind = rows.dtype.newbyteorder("<")
        row_bytes = [row.tobytes() for row in rows.astype(kind)]
        if stride:
            data = b"".join(row.ljust(stride, b"\xaa") for row in row_bytes)
            view = self.view(data, byteStride=stride)
        else:
            view = self.view(b"".join(row_bytes))
        record = {
            "bufferView": view,
            "componentType": TYPES[kind.str[1:]],
            "count": len(rows),
            "type": SHAPES[rows.shape[1]],
        }
        self.record["accessors"].append(record | more)
        return len(self.record["accessors"]) - 1

    def primitive(self, accessors: dict[str, int], **extension: Any) -> dict[str, Any]:
        """A splat primitive of accessors by the names of `splat_arrays`."""
        plain = ("POSITION", "COLOR_0")
        attributes = {name if name in plain else f"{EXTENSION}:{name}": index for name, index in accessors.items()}
        record = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"} | extension
        return {"attributes": attributes, "mode": 0, "extensions": {EXTENSION: record}}

    def mesh(self, *primitives: dict[str, Any]) -> int:
        """Append a mesh."""
        self.record["meshes"].append({"primitives": list(primitives)})
        return len(self.record["meshes"]) - 1

    def node(self, root: bool = True, **values: Any) -> int:
        """Append a node, into the scene if it is a root."""
        self.record["nodes"].append(values)
        index = len(self.record["nodes"]) - 1
        if root:
            self.record["scenes"][0]["nodes"].append(index)
        return index

    def splats(self, arrays: dict[str, np.ndarray], **node: Any) -> dict[str, Any]:
        """Append a splat primitive of arrays, its mesh and its node; returns the primitive."""
        primitive = self.primitive({name: self.accessor(values) for name, values in arrays.items()})
        self.node(mesh=self.mesh(primitive), **node)
        return primitive

    def glb(self, path: Path) -> Path:
        """Write a `.glb`."""
        self.record["buffers"] = [{"byteLength": len(self.data)}]
        path.write_bytes(pack_glb(json.dumps(self.record).encode(), self.data))
        return path

    def gltf(self, path: Path, binary: str | None = None) -> Path:
        """Write a `.gltf` with a data URI, or with a file of the name `binary` beside it."""
        if binary is None:
            uri = "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
        else:
            uri = binary
            (path.parent / binary.replace("%20", " ")).write_bytes(self.data)
        self.record["buffers"] = [{"byteLength": len(self.data), "uri": uri}]
        path.write_text(json.dumps(self.record))
        return path


def pack_glb(text: bytes, data: bytes | None) -> bytes:
    """The bytes of a `.glb`."""
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<2I", len(text), 0x4E4F534A) + text
    if data is not None:
        data += b"\0" * (-len(data) % 4)
        chunks += struct.pack("<2I", len(data), 0x004E4942) + data
    return b"glTF" + struct.pack("<2I", 2, 12 + len(chunks)) + chunks


def glb_record(path: Path) -> dict[str, Any]:
    """The JSON of a `.glb`."""
    data = path.read_bytes()
    record: dict[str, Any] = json.loads(data[20 : 20 + struct.unpack_from("<I", data, 12)[0]])
    return record


def own(path: Path) -> SceneSource:
    """A file's scene in its own frame."""
    return read_gltf(path, str(path), AS_WRITTEN)


def planes(source: SceneSource) -> Planes:
    """All values of a scene."""
    return source.read(slice(0, source.count), list(FIELD))
