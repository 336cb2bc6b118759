"""Recorded launches: what kernels are given, and checksums of what they must give. The self-test plays them back.

A record is made by `benchmarks.self_test` on the NumPy twins and lies beside this module. A kernel whose results change needs
a new one; a test says so.
"""

from __future__ import annotations

import json
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

RECORD = Path(__file__).with_name("self_test.bin")
EXACT_ZEROS = ("dequantize", "grid_rows")
"""Kernels whose zeros must have the right sign too, since their values are written to files. Other kernels use `fma`, and some
devices give it a zero of the wrong sign: docs/devices.md#the-sign-of-zero."""


@dataclass
class Record:
    """Launches and what comes before them, in order."""

    # `["array", number, shape, dtype]`, `["write", number, offset, blob]`, `["fill", number, value, rows or None]`,
    # `["release", number]`, `["launch", kernel, size, arguments, outputs]`. An argument is a number, or `[number]` for
    # an array. An output is `[place of the argument, checksum, blob with the right values or None]`.
    steps: list[list[Any]] = field(default_factory=list)
    # What is written, and right values where no twin can give them.
    blobs: list[np.ndarray] = field(default_factory=list)

    def keep(self, values: np.ndarray) -> int:
        """Put values away; returns their number."""
        self.blobs.append(np.ascontiguousarray(values).reshape(-1).copy())
        return len(self.blobs) - 1

    @property
    def kernels(self) -> set[str]:
        """Names of all kernels that are launched."""
        return {step[1] for step in self.steps if step[0] == "launch"}

    def pack(self) -> bytes:
        """As bytes. Bytes of equal weight lie together, which compresses better."""
        head = json.dumps({"steps": self.steps, "blobs": [[b.dtype.str, b.size] for b in self.blobs]}).encode()
        body = b"".join(b.view(np.uint8).reshape(b.size, -1).T.tobytes() for b in self.blobs)
        return zlib.compress(len(head).to_bytes(4, "little") + head + body, 9)

    @classmethod
    def unpack(cls, data: bytes) -> Record:
        """From the bytes of `pack`."""
        data = zlib.decompress(data)
        at = 4 + int.from_bytes(data[:4], "little")
        head = json.loads(data[4:at])
        blobs = []
        for kind, size in head["blobs"]:
            dtype = np.dtype(kind)
            planes = np.frombuffer(data, np.uint8, size * dtype.itemsize, at).reshape(dtype.itemsize, size)
            blobs.append(np.ascontiguousarray(planes.T).reshape(-1).view(dtype))
            at += size * dtype.itemsize
        return cls(head["steps"], blobs)


def load_record() -> Record:
    """The record that the package ships."""
    return Record.unpack(RECORD.read_bytes())


def canonical(kernel: str, values: np.ndarray) -> np.ndarray:
    """`values` with one pattern for all NaN, and zeros without a sign unless the kernel is one of `EXACT_ZEROS`."""
    if values.dtype.kind != "f":
        return values
    values = values.copy() if kernel in EXACT_ZEROS else values + values.dtype.type(0)
    values[np.isnan(values)] = np.nan
    return values


def checksum(kernel: str, values: np.ndarray) -> int:
    """CRC-32 of the bits of `canonical` values."""
    return zlib.crc32(np.ascontiguousarray(canonical(kernel, values)).view(np.uint8).reshape(-1).data)
