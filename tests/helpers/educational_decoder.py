"""A second decoder of `.fgs` files that follows docs/format.md heading by heading and shares no code with the package.

Written to be read: loops over single codes, no checks beyond the checksums.
"""

from __future__ import annotations

import json
import struct
import zlib
from typing import Any

import numpy as np

ARRAYS = (
    ("means", "xyz"),
    ("sh_dc", "dc"),
    ("sh_rest", "rest"),
    ("opacity_logits", "opacity"),
    ("log_scales", "scale"),
    ("quats", "rot"),
)


def ceil8(bits: int) -> int:
    return (bits + 7) // 8


def decode(data: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The header and {array: [C, R] f32} (`sh_rest` with S rows only)."""
    # Preamble
    magic, version, must, _may, size, header_length, header_crc, crc = struct.unpack("<8sHHIQIII", data[:36])
    assert magic == bytes.fromhex("934647530D0A1A0A") and version == 1 and must == 0
    assert size == len(data) and crc == zlib.crc32(data[:32])

    # Header
    text = data[36 : 36 + header_length]
    assert header_crc == zlib.crc32(text)
    header = json.loads(text)

    # Words: the six arrays
    channels = {"xyz": 3, "dc": 3, "rest": 3 * ((header["sh_degree"] + 1) ** 2 - 1), "opacity": 1, "scale": 3, "rot": 4}
    rows = {name: header["sh_count"] if name == "rest" else header["count"] for name in channels}

    # Ranges
    at = start = 36 + header_length
    low: dict[str, np.ndarray] = {}
    step: dict[str, np.ndarray] = {}
    for _, name in ARRAYS:
        for table in (low, step):
            shape = (channels[name], header["groups"][name])
            table[name] = np.frombuffer(data, "<f4", shape[0] * shape[1], at).reshape(shape)
            at += 4 * shape[0] * shape[1]
    assert struct.unpack_from("<I", data, at)[0] == zlib.crc32(data[start:at])
    at += 4

    # Chunks
    codes: dict[str, list[list[int]]] = {name: [[] for _ in range(channels[name])] for name in channels}
    chunks = []
    for first in range(0, header["count"], 65536):
        start = at
        for _, name in ARRAYS:
            bits = header["bits"][name]
            r = max(min(first + 65536, rows[name]) - first, 0)
            for channel in range(channels[name]):
                length = ceil8(r * bits)
                plane = int.from_bytes(data[at : at + length], "little")
                codes[name][channel] += [plane >> (i * bits) & (2**bits - 1) for i in range(r)]
                at += length
        chunks.append((at - start, zlib.crc32(data[start:at])))

    # Chunk table
    start = at
    for length, crc in chunks:
        assert struct.unpack_from("<II", data, at) == (length, crc)
        at += 8
    assert struct.unpack_from("<I", data, at)[0] == zlib.crc32(data[start:at])
    assert at + 4 == size

    # Values
    values = {}
    for array, name in ARRAYS:
        values[array] = np.empty((channels[name], rows[name]), np.float32)
        groups = header["groups"][name]
        for group in range(groups):
            for i in range(group * rows[name] // groups, (group + 1) * rows[name] // groups):
                for channel in range(channels[name]):
                    product = np.float32(codes[name][channel][i]) * step[name][channel, group]
                    values[array][channel, i] = low[name][channel, group] + product
    if "contraction" in header:
        values["means"] = expanded(values["means"], header["contraction"])
    return header, values


def expanded(means: np.ndarray, contraction: dict[str, Any]) -> np.ndarray:
    """Positions, from contracted ones ([3, n] f32 both). Python's floats are binary64."""
    centre, radius = contraction["centre"], contraction["radius"]
    result = means.copy()
    for i in range(means.shape[1]):
        away = [float(means[axis, i]) - centre[axis] for axis in range(3)]
        a = max(abs(value) for value in away) / radius
        if a > 1:
            k = min(int(a) - 1, 63)
            for axis in range(3):
                place = centre[axis] + away[axis] * ((a - k) * 2.0**k / a)
                result[axis, i] = np.float32(min(max(place, -(2.0**126)), 2.0**126))
    return result
