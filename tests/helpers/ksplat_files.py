"""`.ksplat` files for tests: sections in buckets, at all levels, by the layout of GaussianSplats3D."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexgs_edge.scene.fields import sh_rest_count
from flexgs_edge.scene.source import Planes

REALS = ("<f4", "<f2", "<f2")


@dataclass(frozen=True)
class Part:
    """A section: its values, and how many of them are in each bucket (full ones first)."""

    planes: Planes
    degree: int
    buckets: Sequence[int]
    capacity: int
    room: int = 0
    """Rows of zeros behind the Gaussians."""
    block: float = 4.0
    """Side of a bucket, scene units."""


def row_parts(part: Part, level: int) -> tuple[list[np.ndarray], np.ndarray]:
    """Columns of a section's rows as bytes, and the centres of its buckets."""
    planes, real = part.planes, REALS[level]
    starts = np.cumsum([0, *part.buckets])
    means = planes["means"].T
    centres = np.array([means[a:b].mean(axis=0) for a, b in zip(starts, starts[1:])], "<f4").reshape(-1, 3)
    if level:
        step = part.block / 2 / 32767
        offsets = means - np.repeat(centres, part.buckets, axis=0)
        place = np.clip(np.rint(offsets / step) + 32767, 0, 65535).astype("<u2")
    else:
        place = means.astype("<f4")
    opaque = 255 / (1 + np.exp(-planes["opacity_logits"]))
    colour = np.concatenate([255 * (planes["sh_dc"] * 0.28209479177387814 + 0.5), opaque])
    count, order = sh_rest_count(part.degree), []
    for degree in range(1, part.degree + 1):
        for channel in range(3):
            order += range(channel * count + degree**2 - 1, channel * count + (degree + 1) ** 2 - 1)
    sh = planes["sh_rest"][order].T
    rest = np.clip(np.rint((sh + 1.5) / 3 * 255), 0, 255).astype("u1") if level == 2 else sh.astype(real)
    columns = [place, np.exp(planes["log_scales"]).T.astype(real), planes["quats"].T.astype(real)]
    columns += [np.clip(np.rint(colour.T), 0, 255).astype("u1"), rest]
    return [np.ascontiguousarray(column).view("u1") for column in columns], centres


def ksplat(level: int, parts: Sequence[Part], spare_sections: int = 0) -> bytes:
    """A whole file."""
    heads, bodies, total = b"", b"", 0
    for part in parts:
        columns, centres = row_parts(part, level)
        table = np.concatenate(columns, axis=1)
        total += len(table)
        full = sum(size == part.capacity for size in part.buckets)
        others = np.array(part.buckets[full:], "<u4")
        head = struct.pack("<IIIIfHxxIxxxxIIH", len(table), len(table) + part.room, part.capacity, len(part.buckets), part.block,
                           12, 32767 if level else 1, full, len(others), part.degree)  # fmt: skip
        heads += head.ljust(1024, b"\0")
        bodies += others.tobytes() + centres.tobytes() + table.tobytes() + bytes(part.room * table.shape[1])
    sections = len(parts) + spare_sections
    head = struct.pack("<BBxxIIIIHxxffff", 0, 1, sections, len(parts), total, total, level, 0, 0, 0, 0)
    return head.ljust(4096, b"\0") + heads + bytes(1024 * spare_sections) + bodies
