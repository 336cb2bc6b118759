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
from flexgs_edge.codec.channels import Channels, channel_parts
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

    The header is read; of version 2 a file that was cut is decoded, since entropy coding shares the bytes out.
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
    """A file of version 2: what each channel takes stands in its header, or is known once its symbols have been decoded."""
    container = GridContainer(path)
    header = container.header
    known = header.channels or _decoded_channels(path, header)
    layers = [{"rows": rows, "bytes": 0} for rows in header.layers]
    for chunk, entry in zip(header.chunks(), container.read_table(), strict=True):
        layers[chunk.layer]["bytes"] += entry.section.length
    channels = {}
    for name, total in zip(channel_parts(header.sh_degree), known.bytes, strict=True):
        degree = int(name.split()[1]) if name.startswith("sh ") and name != "sh degree" else 0
        rows = (header.count, *known.rows)[degree]
        channels[name] = {
            "rows": rows,
            "step": header.steps["sh"][degree - 1] if degree else header.steps.get(name),
            "bytes": total,
            "bits_per_row": round(8 * total / rows, 3) if rows else None,
            "bits_per_gaussian": round(8 * total / header.count, 3) if header.count else None,
        }
    return {
        **_fgs_record(path, header, 2, known.rows[0] if known.rows else 0, channels),
        "chroma": header.steps["chroma"],
        "model_bytes": header.model.length,
        "layers": layers,
        "cut_from": header.cut_from,
    }


def _decoded_channels(path: Path, header: GridHeader) -> Channels:
    """What a file does not say of itself, such as one that was cut."""
    rows = np.zeros(header.sh_degree, np.int64)

    def count(chunk: Chunk, entry: ChunkEntry, codes: ChunkCodes) -> None:
        degrees = codes.base["sh degree"]
        rows[:] += [int(np.count_nonzero(degrees > degree)) for degree in range(header.sh_degree)]

    taken = channel_bytes(path, count)
    return Channels.of(taken, rows.tolist())


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
