"""Notes at places of a scene, which its page shows."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from flexgs_edge.cameras.json_values import Entry, kind, load_json
from flexgs_edge.errors import FormatError, brief

NOTES_MOST = 1000
"""Most notes of a page, which places all of them with every frame."""


def read_notes(path: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """Read a JSON list of objects with `at` (three numbers, world coordinates) and `text`.

    Raises `InputError` if the file cannot be read, and `FormatError` for any other content.
    """
    found = load_json(Path(path), "the notes")
    if not isinstance(found, list):
        raise FormatError(f"{path}: expected a list of notes, found {kind(found)}")
    if len(found) > NOTES_MOST:
        raise FormatError(f"{path}: expected at most {NOTES_MOST} notes, found {len(found)}")
    return [_note(Entry(f"{path}: note {number}", note)) for number, note in enumerate(found, 1)]


def _note(entry: Entry) -> dict[str, Any]:
    at, text = entry.array("at", (3,)), entry.get("text")
    if not isinstance(text, str) or not text.strip():
        raise entry.fail("text", "a text", brief(text))
    return {"at": at.tolist(), "text": text}
