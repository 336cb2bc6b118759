"""Read one level of detail of a streamed SOG scene of PlayCanvas: `lod-meta.json` and the folders that it names.

The leaves of its tree name ranges of rows in SOG scenes, for each level that they have. Level 0 is the finest.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from flexgs_edge.errors import FormatError, InputError, brief
from flexgs_edge.io.decoded import DecodedSource
from flexgs_edge.io.pieces import is_there, piece_place
from flexgs_edge.io.reading import Reading
from flexgs_edge.io.sog import META, SogSource, read_sog, read_sog_folder
from flexgs_edge.io.sog_meta import JsonObject, parse_object
from flexgs_edge.scene.fields import FIELD, sh_rest_count
from flexgs_edge.scene.source import Rows, by_chunk

_MOST_LEVELS = 64
_MOST_ROWS = 2**31 - 1


@dataclass(frozen=True)
class _Range:
    """Rows of a leaf at one level: `file` is a place in `filenames`."""

    file: int
    offset: int
    count: int

    @property
    def stop(self) -> int:
        return self.offset + self.count


def read_streamed_sog(path: Path, name: str, reading: Reading) -> StreamedSource:
    """Open the level that is asked for, by default the finest whose files are there; see `read_foreign`.

    Raises `InputError` if the level is not there. Raises `FormatError` if a file is damaged, or ranges do not fit the
    files that they name.
    """
    top = parse_object(path.read_bytes(), f"{name}: lod-meta.json")
    if top.has("version"):
        top.integer("version", 1, 1)
    levels = top.integer("lodLevels", 1, _MOST_LEVELS)
    files = top.names("filenames")
    ranges = _ranges(top, levels, len(files))
    here = cache(lambda file: is_there(path.parent, files[file], name))
    missing = [next((files[part.file] for part in level if not here(part.file)), None) for level in ranges]
    level, notes = _chosen(reading.lod, [bool(level) for level in ranges], missing, name)
    # One file may have several names, such as a.sog and ./a.sog.
    places = {
        file: piece_place(path.parent, files[file], name) for file in sorted({part.file for part in ranges[level]})
    }
    first = {place: file for file, place in reversed(places.items())}
    level_ranges = [replace(part, file=first[places[part.file]]) for part in ranges[level]]
    held = 0

    def opened(file: str) -> SogSource:
        nonlocal held
        scene = _open(path.parent, file, name, reading.beside(held))
        held += scene.held_bytes
        return scene

    scenes = {file: opened(files[file]) for file in sorted(first.values())}
    _check_ranges(top, level_ranges, scenes, files)
    parts = [(scenes[part.file], part.offset, part.count) for part in level_ranges]
    if top.has("environment") and top.value["environment"] != "":
        environment = top.name("environment")
        if is_there(path.parent, environment, name):
            scene = opened(environment)
            parts.append((scene, 0, scene.count))
        else:
            notes += (f"the environment {brief(environment)} is not there: left out",)
    source = StreamedSource(name, [part for part in parts if part[2]], notes)
    pieces = {id(scene): scene.file_bytes or 0 for scene, _, _ in parts}
    source.file_bytes = path.stat().st_size + sum(pieces.values())
    return source


class StreamedSource(DecodedSource):
    """Ranges of rows of several SOG scenes, one behind the other.

    `name`: what messages call it. `parts`: a scene, its first row and the number of rows of each range; none of them
    empty. `notes`: notes of the reader.
    """

    def __init__(self, name: str, parts: Sequence[tuple[SogSource, int, int]], notes: tuple[str, ...]) -> None:
        self._parts = parts
        counts = [count for _, _, count in parts]
        self._starts = np.cumsum([0, *counts], dtype=np.int64)[:-1]
        scenes = {id(scene): scene for scene, _, _ in parts}.values()
        degree = max((scene.sh_degree for scene in scenes), default=0)
        super().__init__(name, sum(counts), degree, sum(scene.held_bytes for scene in scenes))
        self.notes = tuple(dict.fromkeys([*notes, *(note for scene in scenes for note in scene.notes)]))
        if any(scene.settings for scene in scenes):
            self.settings = {"antialiased": True}

    def decode(self, rows: Rows, field: str) -> np.ndarray:
        """See `DecodedSource.decode`."""
        size = rows.stop - rows.start if isinstance(rows, slice) else len(rows)
        values = np.zeros((FIELD[field].width(self.sh_degree), size))
        for number, some, place in by_chunk(rows, self._starts):
            scene, offset, _ = self._parts[number]
            shift = offset - int(self._starts[number])
            moved: Rows = slice(some.start + shift, some.stop + shift) if isinstance(some, slice) else some + shift
            if field != "sh_rest":
                values[:, place] = scene.decode(moved, field)
            elif scene.sh_degree:  # of a lower degree than others, perhaps
                inner = scene.decode(moved, field).reshape(3, sh_rest_count(scene.sh_degree), -1)
                values.reshape(3, -1, size)[:, : inner.shape[1], place] = inner
        return values


def _ranges(top: JsonObject, levels: int, files: int) -> list[list[_Range]]:
    """The ranges of every level, in the order of the tree's leaves, without empty ones."""
    ranges: list[list[_Range]] = [[] for _ in range(levels)]
    waiting = [top.inner("tree")]
    while waiting:
        node = waiting.pop()
        if node.has("lods"):
            lods = node.inner("lods")
            for key in lods.value:
                if not (key.isascii() and key.isdigit() and len(key) < 4 and int(key) < levels):
                    raise FormatError(
                        f"{top.place}: {lods.path}: expected levels 0 to {levels - 1}, found {brief(key)}"
                    )
                entry = lods.inner(key)
                found = _Range(
                    entry.integer("file", 0, files - 1),
                    entry.integer("offset", 0, _MOST_ROWS) if entry.has("offset") else 0,
                    entry.integer("count", 0, _MOST_ROWS),
                )
                if found.count:
                    ranges[int(key)].append(found)
            continue
        children = node.value.get("children")
        if not isinstance(children, list):
            raise FormatError(f"{top.place}: {node.path.rstrip('.')}: expected a node with lods or a list of children")
        paths = [f"{node.path}children[{i}]." for i in range(len(children))]
        waiting += [JsonObject(top.place, child, path) for child, path in zip(children, paths)][::-1]
    return ranges


def _chosen(asked: int | None, filled: list[bool], missing: list[str | None], name: str) -> tuple[int, tuple[str, ...]]:
    """The level to read, and a note if it is not the finest of all."""
    there = [level for level, full in enumerate(filled) if full and missing[level] is None]
    words = ", ".join(map(str, there)) or "none"
    if asked is not None and asked not in there:
        why = "there is no such level"
        if asked < len(filled):
            why = f"{brief(missing[asked])} is not there" if missing[asked] else "no leaf has it"
        raise InputError(f"{name}: --lod {asked}: {why}; levels whose files are all there: {words}")
    if not there:
        first = next((file for file in missing if file), None)
        found = f"no file {brief(first)}; was everything copied?" if first else "a tree whose leaves have no level"
        raise FormatError(f"{name}: expected a level whose files are all there, found {found}")
    level = there[0] if asked is None else asked
    finer = [other for other in range(level) if filled[other] and other not in there]
    note = f"level of detail {level} of {len(filled)}, the finest that is there"
    return level, (note,) if finer and asked is None else ()


def _open(folder: Path, file: str, name: str, reading: Reading) -> SogSource:
    """The scene behind a `meta.json`, or behind a zip, which some programs take too."""
    place, inner = piece_place(folder, file, name), f"{name}: {file}"
    if file.lower().endswith(".sog"):
        source = read_sog(place, inner, reading)
        source.file_bytes = place.stat().st_size
        return source
    return read_sog_folder(place if place.name else place / META, inner, reading)


def _check_ranges(
    top: JsonObject, ranges: Sequence[_Range], scenes: Mapping[int, SogSource], files: Sequence[str]
) -> None:
    """Raise `FormatError` if ranges leave their file, or overlap: a small tree could ask for any number of rows."""
    last = dict.fromkeys(scenes, 0)
    for part in sorted(ranges, key=lambda part: (part.file, part.offset)):
        found = f"rows {part.offset} to {part.stop} of {files[part.file]}"
        if part.stop > scenes[part.file].count:
            raise FormatError(f"{top.place}: expected {scenes[part.file].count} rows at most, found {found}")
        if part.offset < last[part.file]:
            raise FormatError(
                f"{top.place}: expected each row in one leaf, found {found} where others end at {last[part.file]}"
            )
        last[part.file] = part.stop
