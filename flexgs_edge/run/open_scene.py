"""Open a scene file with the reader of its suffix."""

from __future__ import annotations

import os
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path

from flexgs_edge.errors import InputError
from flexgs_edge.io.formats import FORMATS
from flexgs_edge.io.model_folder import latest_iteration
from flexgs_edge.io.ply import PlySource
from flexgs_edge.scene.source import SceneSource

READERS: dict[str, str] = {
    ".ply": "flexgs_edge.io.ply:PlySource",
    ".fgs": "flexgs_edge.codec.open_fgs:open_fgs",
    **dict.fromkeys(FORMATS, "flexgs_edge.io.exchange:read_foreign"),
}
"""Readers by suffix, as `module:function`. A reader is imported only when a file needs it, so start-up stays fast."""


def open_scene(path: str | os.PathLike[str], readers: Mapping[str, str] = READERS) -> SceneSource:
    """Open a scene file by its suffix, or the latest iteration of INRIA's model folder.

    Parameters
    ----------
    path : path
        A file, or the folder that INRIA's training program writes.
    readers : mapping, optional
        `module:function` for each suffix, with its dot.

    Raises
    ------
    InputError
        If the path does not exist or its suffix is unknown.
    FormatError
        If the file does not follow its format.
    """
    place = Path(path)
    supported = f"supported: files ending in {', '.join(readers)}, or a model folder with point_cloud/iteration_*"
    if place.is_dir():
        return PlySource(latest_iteration(place))
    if not place.exists():
        raise InputError(f"{path}: no such file or folder; {supported}")
    # Use the longest suffix: .compressed.ply is another format than .ply.
    suffixes = [suffix for suffix in readers if place.name.lower().endswith(suffix) and place.suffix]
    if not suffixes:
        raise InputError(f"{path}: unknown kind of scene {place.suffix!r}; {supported}")
    module, _, name = readers[max(suffixes, key=len)].partition(":")
    source: SceneSource = getattr(import_module(module), name)(place)
    return source
