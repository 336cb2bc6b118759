"""Read one level of detail of a streamed SOG scene of PlayCanvas: `lod-meta.json` and the folders that it names.

The leaves of its tree name ranges of rows in SOG scenes, for each level that they have. Level 0 is the finest.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from flexgs_edge.errors import FormatError, InputError, brief
from flexgs_edge.files import parse_json
from flexgs_edge.io.decoded import PartsSource
from flexgs_edge.io.json_object import JsonObject
from flexgs_edge.io.reading import Reading
from flexgs_edge.io.sog import META, SogSource, is_there, piece_place, read_sog, read_sog_folder
from flexgs_edge.scene.source import Rows

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


def read_streamed_sog(path: Path, name: str, reading: Reading) -> "StreamedSource":
    """Open the level that is asked for, by default the finest whose files are there; see `read_foreign`.

    Raises `InputError` if the level is not there. Raises `FormatError` if a file is damaged, or ranges do not fit the
    files that they name.
    """
    place = f"{name}: lod-meta.json"
    top = JsonObject(place, parse_json(path.read_bytes(), place))
    top.whole("version", 1, 1, 1)
    levels = top.whole("lodLevels", None, 1, _MOST_LEVELS)
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
    if "environment" in top and top.value["environment"] != "":
        environment = top.text("environment")
        if is_there(path.parent, environment, name):
            scene = opened(environment)
            parts.append((scene, 0, scene.count))
        else:
            notes += (f"the environment {brief(environment)} is not there: left out",)
    source = StreamedSource(name, [part for part in parts if part[2]], notes)
    pieces = {id(scene): scene.file_bytes or 0 for scene, _, _ in parts}
    source.file_bytes = path.stat().st_size + sum(pieces.values())
    return source


class StreamedSource(PartsSource):
    """Ranges of rows of several SOG scenes, one behind the other.

    `name`: what messages call it. `parts`: a scene, its first row and the number of rows of each range; none of them
    empty. `notes`: notes of the reader.
    """

    def __init__(self, name: str, parts: Sequence[tuple[SogSource, int, int]], notes: tuple[str, ...]) -> None:
        self._parts = parts
        scenes = {id(scene): scene for scene, _, _ in parts}.values()
        held = sum(scene.held_bytes for scene in scenes)
        super().__init__(name, [count for _, _, count in parts], [scene.sh_degree for scene, _, _ in parts], held)
        self.notes = tuple(dict.fromkeys([*notes, *(note for scene in scenes for note in scene.notes)]))
        if any(scene.settings for scene in scenes):
            self.settings = {"antialiased": True}

    def decode_part(self, number: int, rows: Rows, field: str) -> np.ndarray:
        scene, offset, _ = self._parts[number]
        moved: Rows = slice(rows.start + offset, rows.stop + offset) if isinstance(rows, slice) else rows + offset
        return scene.decode(moved, field)


def _ranges(top: JsonObject, levels: int, files: int) -> list[list[_Range]]:
    """The ranges of every level, in the order of the tree's leaves, without empty ones."""
    ranges: list[list[_Range]] = [[] for _ in range(levels)]
    waiting = [top.needed("tree")]
    while waiting:
        node = waiting.pop()
        if "lods" in node:
            lods = node.needed("lods")
            for key in lods.value:
                if not (key.isascii() and key.isdigit() and len(key) < 4 and int(key) < levels):
                    raise FormatError(
                        f"{top.name}: {lods.place}: expected levels 0 to {levels - 1}, found {brief(key)}"
                    )
                entry = lods.needed(key)
                found = _Range(
                    entry.whole("file", most=files - 1),
                    entry.whole("offset", 0, most=_MOST_ROWS),
                    entry.whole("count", most=_MOST_ROWS),
                )
                if found.count:
                    ranges[int(key)].append(found)
            continue
        children = node.value.get("children")
        if not isinstance(children, list):
            raise FormatError(f"{top.name}: {node.place}: expected a node with lods or a list of children")
        places = [f"{node.place}.children[{i}]" for i in range(len(children))]
        waiting += [JsonObject(top.name, child, place) for child, place in zip(children, places)][::-1]
    return ranges


def _chosen(asked: int | None, filled: list[bool], missing: list[str | None], name: str) -> tuple[int, tuple[str, ...]]:
    """The level to read, and a note if nobody asked for it and there are others."""
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
    if asked is not None or sum(filled) == 1:
        return level, ()
    others = ", ".join(map(str, there[1:]))
    advice = f"; coarser ones: --lod {others}" if others else ""
    return level, (f"level of detail {level} of {len(filled)}, the finest that is there{advice}",)


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
            raise FormatError(f"{top.name}: expected {scenes[part.file].count} rows at most, found {found}")
        if part.offset < last[part.file]:
            raise FormatError(
                f"{top.name}: expected each row in one leaf, found {found} where others end at {last[part.file]}"
            )
        last[part.file] = part.stop
