"""`verify`: every byte of a `.fgs` file against its checksums."""

from __future__ import annotations

import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

from flexgs_edge._version import __version__
from flexgs_edge.codec.header import Section
from flexgs_edge.codec.open_fgs import verify as verify_container
from flexgs_edge.errors import InputError


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
