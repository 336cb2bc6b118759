"""glTF 2.0 as bytes: `.glb` and `.gltf`, its buffers wherever they lie, and the numbers of its accessors.

Every offset, stride and count is checked against the bytes that are there before anything is allocated. Buffers are files
beside the `.gltf`, `data:` URIs or the second chunk of a `.glb`; nothing outside the file's folder is opened.
"""

import base64
import binascii
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote

import numpy as np

from flexgs_edge.errors import FormatError, brief
from flexgs_edge.files import parse_json
from flexgs_edge.io.json_object import JsonObject
from flexgs_edge.scene.source import Rows

MAGIC = b"glTF"
JSON_CHUNK, BIN_CHUNK = 0x4E4F534A, 0x004E4942
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
"""NumPy's name of a component type."""
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_MOST_STRIDE = 252
_BLOCK_BYTES = 1 << 22


@dataclass(frozen=True)
class Packed:
    """Numbers of an accessor as they are stored."""

    values: np.ndarray  # [n, width] of the stored type
    normalized: bool  # whole numbers stand for -1 to 1, or for 0 to 1 if they have no sign

    def read(self, rows: Rows) -> np.ndarray:
        """[width, n] f64, some rows."""
        with np.errstate(invalid="ignore"):  # NaN that signals
            wide = self.values[rows].astype(np.float64).T
        if self.normalized:
            wide = np.maximum(wide / np.iinfo(self.values.dtype).max, -1.0)
        return wide


@dataclass(frozen=True)
class _Buffer:
    """Bytes of a buffer: in memory, or a range of a file."""

    length: int
    data: bytes | None = None
    path: Path | None = None
    start: int = 0

    def read(self, offset: int, length: int) -> np.ndarray:
        if self.data is not None:
            return np.frombuffer(self.data, np.uint8, length, offset).copy()
        assert self.path is not None
        return np.fromfile(self.path, np.uint8, length, offset=self.start + offset)


class GltfFile:
    """An open glTF file.

    `path`: what is opened. `name`: the user's path, for messages; files beside it are looked for there. `json`: the
    whole JSON. `size`: bytes of the file, and of the buffers beside it that were used. `notes`: what was left out.
    Raises `FormatError` if the file is damaged, or is no glTF 2.0.
    """

    def __init__(self, path: Path, name: str) -> None:
        self.path, self.name, self.notes = path, name, list[str]()
        self.size = path.stat().st_size
        self._buffers: dict[int, _Buffer] = {}
        self._packed: dict[int, Packed] = {}
        self._chunk: _Buffer | None = None
        self._opened: set[Path] = set()
        with open(path, "rb") as file:
            head = file.read(4)
            text = self._read_chunks(file.read(16)) if head == MAGIC else head + file.read()
        if not text.strip():
            raise FormatError(f"{name}: not a glTF: the file is empty")
        if head != MAGIC and not text.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{"):
            raise FormatError(
                f"{name}: not a glTF: expected it to begin with 'glTF' or '{{', found {brief(text[:8])}; is it complete?"
            )
        self.json = JsonObject(name, parse_json(text, name))
        asset = self.json.inner("asset").text("version", "none")
        if asset.partition(".")[0] != "2":
            raise FormatError(f"{name}: asset.version: expected 2.0, found {brief(asset)}")

    def _read_chunks(self, head: bytes) -> bytes:
        """Check the chunks of a `.glb`; returns the JSON and remembers where the buffer lies."""
        if len(head) < 16:
            raise FormatError(f"{self.name}: {4 + len(head)} bytes are too few for a .glb; is it complete?")
        version, length, size, kind = struct.unpack("<4I", head)
        if version != 2:
            raise FormatError(f"{self.name}: byte 4: expected version 2 of .glb, found {version}")
        if length > self.size:
            raise FormatError(
                f"{self.name}: byte 8: the header claims {length} bytes, the file has {self.size}; is it complete?"
            )
        if length < self.size:
            self.notes.append(f"{self.size - length} bytes behind the data ignored")
        if kind != JSON_CHUNK or size > length - 20:
            raise FormatError(
                f"{self.name}: byte 12: expected a JSON chunk of at most {max(length - 20, 0)} bytes, "
                f"found {size} bytes of type {kind:#x}; is it complete?"
            )
        with open(self.path, "rb") as file:
            file.seek(20)
            text = file.read(size)
            at = 20 + size
            while at + 8 <= length and self._chunk is None:
                file.seek(at)
                size, kind = struct.unpack("<2I", file.read(8))
                if size > length - at - 8:
                    raise FormatError(
                        f"{self.name}: byte {at}: a chunk of {size} bytes, but {length - at - 8} are left; is it complete?"
                    )
                if kind == BIN_CHUNK:
                    self._chunk = _Buffer(size, path=self.path, start=at + 8)
                at += 8 + size
        return text

    def accessor(self, index: int, asker: str) -> Packed:
        """The numbers of an accessor, which `asker` refers to."""
        if index not in self._packed:
            self._packed[index] = self._read_accessor(self.json.item("accessors", index, asker))
        return self._packed[index]

    def view(self, index: int, asker: str) -> np.ndarray:
        """[n] u8, the bytes of a buffer view."""
        buffer, start, length, _ = self._view(index, asker)
        return buffer.read(start, length)

    @property
    def held_bytes(self) -> int:
        """Bytes of all accessors that were read."""
        return sum(packed.values.nbytes for packed in self._packed.values())

    def _read_accessor(self, record: JsonObject) -> Packed:
        count, component, width = record.whole("count"), record.whole("componentType"), record.text("type")
        if component not in COMPONENTS or component == 5125:
            raise record.fail("componentType", "5120 to 5123 or 5126", component)
        if width not in WIDTHS:
            raise record.fail("type", "SCALAR, VEC2, VEC3 or VEC4", width)
        kind, columns = np.dtype(COMPONENTS[component]), WIDTHS[width]
        normalized = record.flag("normalized")
        if normalized and kind.kind == "f":
            raise record.fail("normalized", "false for floats", True)
        if "bufferView" in record:
            values = self._read_rows(record, record.whole("bufferView"), count, kind, columns)
        elif "sparse" in record:
            # Without a buffer view, all values but the sparse ones are zero, and no bytes stand for them.
            if count * columns * kind.itemsize > 16 * self.size:
                raise record.fail("count", f"a number that a file of {self.size} bytes may have", count)
            values = np.zeros((count, columns), kind)
        else:
            raise FormatError(
                f"{record.name}: {record.place}: has no bufferView: an extension that we do not know may hold its values"
            )
        if "sparse" in record:
            self._replace(record.inner("sparse"), values)
        return Packed(values, normalized)

    def _replace(self, record: JsonObject, values: np.ndarray) -> None:
        """Put the sparse values of an accessor in their places."""
        count, place = record.whole("count"), record.inner("indices")
        component = place.whole("componentType")
        if component not in (5121, 5123, 5125):
            raise place.fail("componentType", "5121, 5123 or 5125", component)
        if count > len(values):
            raise record.fail("count", f"at most {len(values)}", count)
        kind = np.dtype(COMPONENTS[component])
        rows = self._read_rows(place, place.whole("bufferView"), count, kind, 1)[:, 0].astype(np.int64)
        if count and rows.max() >= len(values):
            raise place.fail("indices", f"rows below {len(values)}", int(rows.max()))
        inner = record.inner("values")
        values[rows] = self._read_rows(inner, inner.whole("bufferView"), count, values.dtype, values.shape[1])

    def _read_rows(self, record: JsonObject, view: int, count: int, kind: np.dtype, columns: int) -> np.ndarray:
        """[count, columns], rows of a buffer view, without the bytes between them."""
        buffer, start, length, stride = self._view(view, record.place)
        size, offset = kind.itemsize * columns, record.whole("byteOffset", 0)
        stride = stride or size
        if stride < size:
            raise FormatError(
                f"{record.name}: {record.place}: rows of {size} bytes in bufferViews[{view}], whose byteStride is {stride}"
            )
        needed = offset + stride * (count - 1) + size if count else 0
        if needed > length:
            raise FormatError(
                f"{record.name}: {record.place}: needs {needed} bytes of bufferViews[{view}], which has {length}; "
                "is it complete?"
            )
        if stride == size:
            return buffer.read(start + offset, count * size).view(kind).reshape(count, columns)
        values = np.empty((count, columns), kind)
        step = max(1, _BLOCK_BYTES // stride)
        for at in range(0, count, step):
            rows = min(step, count - at)
            block = buffer.read(start + offset + at * stride, stride * (rows - 1) + size)
            block = np.concatenate([block, np.zeros(stride - size, np.uint8)]).reshape(rows, stride)
            values[at : at + rows] = np.ascontiguousarray(block[:, :size]).view(kind)
        return values

    def _view(self, index: int, asker: str) -> tuple[_Buffer, int, int, int]:
        """A buffer view: its buffer, its first byte there, its length and its stride (0: none)."""
        record = self.json.item("bufferViews", index, asker)
        start, length, stride = (
            record.whole("byteOffset", 0),
            record.whole("byteLength"),
            record.whole("byteStride", 0),
        )
        if stride > _MOST_STRIDE:
            raise record.fail("byteStride", f"at most {_MOST_STRIDE}", stride)
        buffer = self._buffer(record.whole("buffer"), record.place)
        if start + length > buffer.length:
            raise FormatError(
                f"{self.name}: {record.place}: ends at byte {start + length} of a buffer of {buffer.length}; is it complete?"
            )
        return buffer, start, length, stride

    def _buffer(self, index: int, asker: str) -> _Buffer:
        if index not in self._buffers:
            record = self.json.item("buffers", index, asker)
            length = record.whole("byteLength")
            buffer = self._open_buffer(record, index)
            if buffer.length < length:
                raise FormatError(
                    f"{self.name}: {record.place}: byteLength is {length}, but {buffer.length} bytes are there; is it complete?"
                )
            self._buffers[index] = _Buffer(length, buffer.data, buffer.path, buffer.start)
        return self._buffers[index]

    def _open_buffer(self, record: JsonObject, index: int) -> _Buffer:
        if "uri" not in record:
            if index == 0 and self._chunk is not None:
                return self._chunk
            raise FormatError(
                f"{self.name}: {record.place}: has no uri, and the file has no binary chunk for it; is it complete?"
            )
        uri = record.text("uri")
        if uri[:5].lower() == "data:":
            head, comma, text = uri.partition(",")
            if not comma or not head.lower().endswith(";base64"):
                raise record.fail("uri", "a data URI in base64", uri)
            try:
                data = base64.b64decode(text, validate=True)
            except (binascii.Error, ValueError) as error:
                raise FormatError(f"{self.name}: {record.place}: uri: not base64: {error}; is it complete?") from error
            return _Buffer(len(data), data)
        place = self._beside(record, uri)
        size = place.stat().st_size
        self.size += 0 if place in self._opened else size
        self._opened.add(place)
        return _Buffer(size, path=place)

    def _beside(self, record: JsonObject, uri: str) -> Path:
        """The file of a relative URI, which must lie in the folder of the scene."""
        if re.match(r"[A-Za-z][A-Za-z0-9+.-]*:", uri):
            raise record.fail("uri", "the name of a file beside the scene, or a data URI", uri)
        folder = Path(self.name).parent if Path(self.name).exists() else self.path.parent
        try:
            root = folder.resolve()
            place = (root / unquote(uri, errors="strict")).resolve()
            inside, there = place.is_relative_to(root), place.is_file()
        except (OSError, RuntimeError, ValueError) as error:  # a loop of links, a name too long, a byte of zero
            raise record.fail("uri", "the name of a file beside the scene", uri) from error
        if not inside:
            raise record.fail("uri", "a file in the folder of the scene", uri)
        if not there:
            raise FormatError(
                f"{self.name}: {record.place}: no file {brief(uri)} beside it: it holds the scene's values"
            )
        return place
