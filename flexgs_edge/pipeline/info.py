"""`info` and `verify`: what a file holds, and whether every byte of it is whole. Text and JSON come from one builder."""

from __future__ import annotations

import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

from flexgs_edge._version import __version__
from flexgs_edge.budget import format_size
from flexgs_edge.codec.container import Section, read_header
from flexgs_edge.codec.container import verify as verify_container
from flexgs_edge.codec.layout import Header
from flexgs_edge.errors import InputError
from flexgs_edge.quantize import array_bytes
from flexgs_edge.scene import FIELDS, SceneSource, find_companions, inria_dtype, open_scene


def info(path: str | Path) -> dict[str, Any]:
    """What a scene file holds, as JSON values (`info_text` makes the text from them).

    Parameters
    ----------
    path : path
        A `.fgs` (only its header is read), a `.ply` or a model folder.
    """
    place = Path(path)
    if place.suffix.lower() == ".fgs" and place.is_file():
        return _fgs_info(place, read_header(place))
    return _scene_info(place, open_scene(place))


def _fgs_info(path: Path, header: Header) -> dict[str, Any]:
    size = os.stat(path).st_size
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
    settings = dict(header.settings)
    count, degree = settings.get("source_count"), settings.get("source_sh_degree")
    known = isinstance(count, int) and isinstance(degree, int) and 0 <= degree <= 4
    ply = count * inria_dtype(degree).itemsize if known and count is not None and degree is not None else None
    return {
        "program": f"flexgs-edge {__version__}",
        "command": "info",
        "path": os.fspath(path),
        "format": "fgs",
        "size": size,
        "count": header.count,
        "sh_count": header.sh_count,
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


def _scene_info(path: Path, source: SceneSource) -> dict[str, Any]:
    beside = find_companions(path)
    place = Path(source.name)
    ply = source.count * inria_dtype(source.sh_degree).itemsize
    return {
        "program": f"flexgs-edge {__version__}",
        "command": "info",
        "path": source.name,
        "format": place.suffix.lower().lstrip("."),
        "size": os.stat(place).st_size,
        "count": source.count,
        "sh_count": source.sh_count,
        "sh_degree": source.sh_degree,
        "origin": source.origin.tolist(),
        "source_ply_bytes": ply,
        "cameras": None if beside.cameras is None else os.fspath(beside.cameras),
        "images": None if beside.images is None else os.fspath(beside.images),
        "notes": list(source.notes),
    }


def info_text(found: dict[str, Any]) -> str:
    """The text of what `info` found."""
    lines = [f"{found['path']}: {found['format']}, {found['size']} bytes ({format_size(found['size'])})"]
    with_sh = f", {found['sh_count']} of them with SH" if found["format"] == "fgs" else ""
    lines.append(f"Gaussians:   {found['count']}{with_sh}, SH degree {found['sh_degree']}")
    if found.get("ratio"):
        of = f"of the original's PLY, {format_size(found['source_ply_bytes'])}"
        lines.append(f"ratio:       {found['ratio']:.2f}x {of}; {found['bits_per_gaussian']:.1f} bits a Gaussian kept")
    if any(found["origin"]):
        lines.append("origin:      " + ", ".join(f"{value:g}" for value in found["origin"]))
    for word in ("cameras", "images"):
        if word in found:
            lines.append(f"{word + ':':<12} {found[word] or 'none beside it'}")
    lines += [f"note:        {note}" for note in found["notes"]]
    if "channels" in found:
        lines += ["", *_channel_table(found["channels"]), f"headers and checksums: {found['overhead_bytes']} bytes"]
        lines += ["", "settings:", *_settings_lines(found["settings"])]
    return "\n".join(lines) + "\n"


def _channel_table(channels: dict[str, dict[str, Any]]) -> list[str]:
    rows = [("attribute", "channels", "rows", "bits", "groups", "bytes a channel", "ranges", "bytes")]
    for name, item in channels.items():
        words = ("channels", "rows", "bits", "groups", "bytes_per_channel", "range_bytes", "bytes")
        rows.append((name, *(str(item[word]) for word in words)))  # type: ignore[arg-type]
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return [
        "  ".join([row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True))])
        for row in rows
    ]


def _settings_lines(settings: dict[str, Any]) -> list[str]:
    lines = []
    for name, value in settings.items():
        if isinstance(value, dict):
            value = ", ".join(f"{key} {'none' if item is None else item}" for key, item in value.items())
        lines.append(f"  {name.replace('_', ' ')}: {'none' if value is None else value}")
    return lines


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
