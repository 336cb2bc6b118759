"""Several scenes in one command: which scenes the inputs stand for, and how their files are called."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from flexgs_edge.errors import InputError
from flexgs_edge.io.formats import WRITTEN
from flexgs_edge.io.gzipped import GZ
from flexgs_edge.io.model_folder import POINT_CLOUD
from flexgs_edge.progress import LOG
from flexgs_edge.run.open_scene import SUFFIXES, scene_file

StrPath = str | os.PathLike[str]


FGS = ".fgs"
COMPANIONS = (
    "cameras.json", "transforms.json", "cfg_args", "images", "sparse",
    *(f"{name}{end}" for name in ("cameras", "images", "points3D") for end in (".bin", ".txt")),
)  # fmt: skip
"""Names beside scenes that are no scenes and need no words."""
_SUFFIXES = tuple(each for each in SUFFIXES if each.startswith("."))
_ENDINGS = sorted((each + packed for each in _SUFFIXES for packed in ("", GZ)), key=len, reverse=True)
_NAMED = 5  # Most skipped names in one line of the log


def is_batch(inputs: Sequence[StrPath], output: StrPath | None) -> bool:
    """Whether a command has several scenes, or a folder to write to; raises `InputError` for a folder without access."""
    if len(inputs) != 1:
        return True
    if output is not None and (os.fspath(output).endswith(os.sep) or os.path.isdir(output)):
        return True
    return _is_collection(inputs[0]) and bool(_list(inputs[0])[0])


def scenes_of(inputs: Sequence[StrPath], output: StrPath | None, suffix: str) -> list[str]:
    """The scenes that the inputs stand for, in their order, each path once.

    A folder that is no scene stands for the scenes directly in it, by name: files of known suffixes, and folders that are
    scenes. Hidden files and companions are left out, and the log names other files and folders. A folder without scenes
    stays as it is, and `check_place` says why.
    """
    found: dict[str, str] = {}
    for each in inputs:
        places = [os.fspath(each)]
        if _is_collection(each):
            same = output is not None and os.path.realpath(output) == os.path.realpath(each)
            with suppress(InputError):
                inside, skipped = _list(each, suffix if same else None)
                places = inside or places
                if skipped:
                    more = f" and {len(skipped) - _NAMED} more" if len(skipped) > _NAMED else ""
                    LOG.info("%s: skipped %s%s", os.fspath(each), ", ".join(skipped[:_NAMED]), more)
        for place in places:
            found.setdefault(os.path.abspath(place), place)
    return list(found.values())


def _is_collection(place: StrPath) -> bool:
    """Whether this is a folder, but neither a model folder nor one of SOG pictures.

    A folder with a `point_cloud.ply` is a model folder, unless other scenes than results of ours lie beside that file.
    """
    if not os.path.isdir(place):
        return False
    try:
        scene = scene_file(place)
    except InputError:
        return True
    if scene != Path(place) / POINT_CLOUD:
        return False
    with suppress(InputError):
        return len(_list(place, FGS)[0]) > 1
    return False


def _list(folder: StrPath, written: str | None = None) -> tuple[list[str], list[str]]:
    """Paths of the scenes in a folder, and names of what else is there. Files that end in `written` are no scenes."""
    try:
        names = sorted(os.listdir(folder))
    except OSError as error:
        raise InputError(f"{folder}: cannot list the folder ({error.strerror})") from error
    found, skipped = [], []
    for name in names:
        place = os.path.join(folder, name)
        if name.startswith(".") or name in COMPANIONS:
            continue
        if os.path.isdir(place):
            known = not _is_collection(place)
        else:
            old = written is not None and name.lower().endswith(written)
            known = _ending(name) != "" and not old and os.path.isfile(place)
        if known:
            found.append(place)
        else:
            skipped.append(name)
    return found, skipped


def check_place(scene: StrPath) -> None:
    """Raise `InputError` for a folder that has no scenes or cannot be listed."""
    if _is_collection(scene):
        _list(scene)
        raise InputError(
            f"{scene}: no scene to compress in this folder: expected files that end in {', '.join(_SUFFIXES)}, or folders "
            f"with {POINT_CLOUD}, point_cloud/iteration_*, meta.json or lod-meta.json"
        )


def output_names(scenes: Sequence[str], suffix: str) -> list[str]:
    """A file name for each scene: its own, with the suffix replaced.

    Scenes of the same name keep their suffix as well (`a.ply.fgs`, `a.spz.fgs`). If that does not tell them apart, the
    names of their folders come first (`left-a.ply.fgs`, `right-a.ply.fgs`). The order of the scenes does not matter.

    >>> output_names(["x/a.ply", "x/b.ply"], ".fgs")
    ['a.fgs', 'b.fgs']
    >>> output_names(["x/a.ply", "x/a.spz", "x/b.ply"], ".fgs")
    ['a.ply.fgs', 'a.spz.fgs', 'b.fgs']
    >>> output_names(["x/a.ply", "y/a.ply"], ".fgs")
    ['x-a.ply.fgs', 'y-a.ply.fgs']

    Raises `InputError` if two names stay the same.
    """
    parts = [_parts(scene) for scene in scenes]
    depths = [0] * len(scenes)
    while True:
        names = [_name(part, depth) + suffix for part, depth in zip(parts, depths, strict=True)]
        count = Counter(names)
        same = [index for index, name in enumerate(names) if count[name] > 1]
        if not same:
            return names
        if all(depths[index] > len(parts[index]) for index in same):
            raise InputError(
                f"{', '.join(scenes[index] for index in same)}: all would be written as {names[same[0]]}; "
                "compress each on its own"
            )
        for index in same:
            depths[index] += 1


def _parts(scene: str) -> tuple[str, ...]:
    """The names on the way to a scene. The last is that of the scene: of a folder with `meta.json`, not of that file."""
    place = Path(os.path.abspath(scene))
    if place.name.lower().endswith("meta.json") and not place.is_dir():
        place = place.parent
    return place.parts[1:] or ("scene",)


def _name(parts: tuple[str, ...], depth: int) -> str:
    """The name at a depth: 0 is without the suffix, 1 with it, and each further one adds a folder in front."""
    if depth > 0:
        return "-".join(parts[-depth:])
    return parts[-1][: len(parts[-1]) - len(_ending(parts[-1]))] or parts[-1]


def _ending(name: str) -> str:
    """The known suffix of a file name, with `.gz` if it is packed; "" if there is none."""
    lower = name.lower()
    return next((each for each in _ENDINGS if lower.endswith(each)), "")


def output_suffix(word: str | None) -> str:
    """The suffix that `--format` names, with its dot; raises `InputError` for one that is not written."""
    if word is None:
        return FGS
    suffix = f".{word.lower().lstrip('.')}"
    if suffix not in (FGS, *WRITTEN):
        raise InputError(f"--format {word}: expected one of {', '.join((FGS, *WRITTEN))}")
    return suffix


def single_output(output: StrPath | None, word: str | None, dry_run: bool) -> StrPath | None:
    """The file of a single scene, which `--format` must agree with. A dry run without a file gets its format from it."""
    if word is None:
        return output
    suffix = output_suffix(word)
    if output is None:
        return f"scene{suffix}" if dry_run else None
    if not os.fspath(output).lower().endswith(suffix):
        raise InputError(f"--format {word} with -o {output}: the name does not end in {suffix}; leave --format out")
    return output
