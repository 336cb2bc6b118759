"""What a `.fgs` holds, and whether every byte of it is whole."""

from __future__ import annotations

import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge._version import __version__
from flexgs_edge.codec import channel_bytes, read_header
from flexgs_edge.codec import verify as verify_container
from flexgs_edge.codec.coder import Chunk
from flexgs_edge.codec.container2 import GridContainer
from flexgs_edge.codec.layout import Header, Section
from flexgs_edge.codec.layout2 import GridHeader
from flexgs_edge.codec.sections import ChunkEntry
from flexgs_edge.codec.walk import ChunkCodes
from flexgs_edge.errors import InputError
from flexgs_edge.quantize import array_bytes
from flexgs_edge.scene import FIELDS, inria_dtype


def contents(path: str | Path) -> dict[str, Any]:
    """`info` of a `.fgs`.

    Of version 1 only the header is read; version 2 is decoded, since entropy coding shares the bytes out.
    """
    place = Path(path)
    header = read_header(place)
    return _packed_info(place, header) if isinstance(header, Header) else _grid_info(place)


def _packed_info(path: Path, header: Header) -> dict[str, Any]:
    """A file of version 1: bit-packed arrays, whose bytes follow from the header."""
    channels: dict[str, dict[str, Any]] = {}
    for field in FIELDS:
        rows, width, bits = header.rows(field.name), header.width(field.name), header.bits.of(field.name)
        groups = header.groups[field.bits]
        total = array_bytes(rows, width, bits, groups)
        channels[field.bits] = {
            "field": field.name,
            "channels": width,
            "rows": rows,
            "bits": bits,
            "groups": groups,
            "range_bytes": 8 * width * groups,
            "bytes": total,
            "bytes_per_channel": total // width if width else 0,
        }
    return _fgs_record(path, header, 1, header.sh_count, channels)


def _grid_info(path: Path) -> dict[str, Any]:
    """A file of version 2: what each channel takes is known once its symbols have been decoded."""
    header = GridContainer(path).header
    rows_of_degree = np.zeros(header.sh_degree + 1, np.int64)
    layers = [{"rows": rows, "bytes": 0} for rows in header.layers]

    def count(chunk: Chunk, entry: ChunkEntry, codes: ChunkCodes) -> None:
        degrees = codes.base["sh degree"]
        rows_of_degree[:] += [int(np.count_nonzero(degrees >= degree)) for degree in range(header.sh_degree + 1)]
        layers[chunk.layer]["bytes"] += entry.section.length

    taken = channel_bytes(path, count)
    channels = {}
    for name, parts in _grid_parts(header.sh_degree).items():
        degree = int(name.split()[1]) if name.startswith("sh ") and name != "sh degree" else 0
        rows, total = int(rows_of_degree[degree]), sum(taken[part] for part in parts)
        channels[name] = {
            "rows": rows,
            "step": header.steps["sh"][degree - 1] if degree else header.steps.get(name),
            "bytes": round(total),
            "bits_per_row": round(8 * total / rows, 3) if rows else None,
            "bits_per_gaussian": round(8 * total / header.count, 3) if header.count else None,
        }
    sh_count = int(rows_of_degree[1]) if header.sh_degree else 0
    return {
        **_fgs_record(path, header, 2, sh_count, channels),
        "chroma": header.steps["chroma"],
        "model_bytes": round(taken["model"]),
        "layers": layers,
        "cut_from": header.cut_from,
    }


def _grid_parts(sh_degree: int) -> dict[str, tuple[str, ...]]:
    """Kinds of value of version 2, and the coder's channels that make them up."""
    parts: dict[str, tuple[str, ...]] = {"position": ("position", "repeats")}
    parts |= {name: tuple(f"{name} {axis}" for axis in "xyz") for name in ("scale", "rotation")}
    parts |= {"opacity": ("opacity",), "dc": ("dc Y", "dc Co", "dc Cg"), "sh degree": ("sh degree",)}
    return parts | {f"sh {d}": tuple(f"sh {d} {c}" for c in ("Y", "Co", "Cg")) for d in range(1, sh_degree + 1)}


def _fgs_record(
    path: Path, header: Header | GridHeader, version: int, sh_count: int, channels: dict[str, dict[str, Any]]
) -> dict[str, Any]:
    """What files of both versions tell."""
    size = os.stat(path).st_size
    settings = dict(header.settings)
    count, degree = settings.get("source_count"), settings.get("source_sh_degree")
    known = isinstance(count, int) and isinstance(degree, int) and 0 <= degree <= 4
    ply = count * inria_dtype(degree).itemsize if known and count is not None and degree is not None else None
    return {
        "program": f"flexgs-edge {__version__}",
        "command": "info",
        "path": os.fspath(path),
        "format": "fgs",
        "version": version,
        "size": size,
        "count": header.count,
        "sh_count": sh_count,
        "sh_degree": header.sh_degree,
        "origin": list(header.origin),
        "bits_per_gaussian": round(8 * size / header.count, 3) if header.count else None,
        "source_ply_bytes": ply,
        "ratio": round(ply / size, 4) if ply else None,
        "channels": channels,
        "overhead_bytes": size - sum(channel["bytes"] for channel in channels.values()),
        "settings": settings,
        "notes": [],
    }


def verify(path: str | Path) -> list[Section]:
    """Check every checksum of a `.fgs` file.

    Returns
    -------
    list of Section
        Name, offset, bytes and verdict of every part, in the order of the file.

    Raises
    ------
    FormatError
        When the header itself is damaged: nothing behind it can be found then.
    """
    place = Path(path)
    if place.is_dir() or (place.exists() and place.suffix.lower() != ".fgs"):
        raise InputError(f"{path}: expected a .fgs file: other formats have no checksums to verify")
    return verify_container(place, raise_errors=False)


def verify_json(path: str | Path, sections: list[Section]) -> dict[str, Any]:
    """What `verify` found, as JSON values."""
    return {
        "program": f"flexgs-edge {__version__}",
        "command": "verify",
        "path": os.fspath(path),
        "ok": all(section.ok for section in sections),
        "sections": [asdict(section) for section in sections],
    }


def verify_text(path: str | Path, sections: list[Section]) -> str:
    """What `verify` found, a line a part."""
    lines = [f"{s.name:<12} {s.length:>12} bytes at {s.offset:>12}  {'ok' if s.ok else 'DAMAGED'}" for s in sections]
    total, bad = sum(section.length for section in sections), sum(not section.ok for section in sections)
    lines.append(
        f"{path}: {total} bytes, {f'{bad} of {len(sections)} parts DAMAGED' if bad else 'every checksum holds'}"
    )
    return "\n".join(lines) + "\n"
