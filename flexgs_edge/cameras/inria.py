"""Read and write INRIA's cameras.json, the list of poses (camera to world) of the reference training program."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from flexgs_edge.cameras.camera import Camera, distinct_names
from flexgs_edge.cameras.json_values import Entry, kind, load_json
from flexgs_edge.errors import FormatError
from flexgs_edge.small_matrices import product


def read_inria(path: str | os.PathLike[str]) -> list[Camera]:
    """Read INRIA's cameras.json in the file's order.

    The file has no principal point, so it is the middle of the image: (W - 1) / 2, with integer pixel centres.
    The reference program drops folders and what follows the first dot from names: equal ones get `#` and their place.

    Raises `InputError` if the file cannot be read. Raises `FormatError` if it is not JSON, not a list, empty, or an
    entry is wrong; the message names file, entry and field.
    """
    path = Path(path)
    return cameras_of_list(path, load_json(path))


def cameras_of_list(path: Path, entries: Any) -> list[Camera]:
    """`read_inria` for JSON that is loaded already."""
    if not isinstance(entries, list):
        hint = "; this looks like a NeRF transforms.json" if isinstance(entries, dict) and "frames" in entries else ""
        raise FormatError(f"{path}: expected a JSON list of cameras, found {kind(entries)}{hint}")
    if not entries:
        raise FormatError(f"{path}: the list of cameras is empty")
    cameras = [_camera(Entry(f"{path}: camera {index}", entry)) for index, entry in enumerate(entries)]
    names = distinct_names([camera.name for camera in cameras])
    return [replace(camera, name=name) for camera, name in zip(cameras, names)]


def inria_json(cameras: Sequence[Camera]) -> str:
    """The text of INRIA's cameras.json, one camera a line; it has no place for principal points and distortion."""
    entries = [
        {
            "id": number,
            "img_name": camera.name,
            "width": camera.width,
            "height": camera.height,
            "position": camera.center.tolist(),
            "rotation": camera.rotation.T.tolist(),
            "fy": camera.fy,
            "fx": camera.fx,
        }
        for number, camera in enumerate(cameras)
    ]
    return "[\n" + ",\n".join(json.dumps(entry) for entry in entries) + "\n]\n"


def _camera(entry: Entry) -> Camera:
    name = entry.name("img_name")
    width, height = entry.side("width"), entry.side("height")
    fx, fy = entry.focal("fx"), entry.focal("fy")
    position = entry.array("position", (3,))
    turn = entry.array("rotation", (3, 3))
    entry.check_rotation("rotation", turn)
    rotation = turn.T
    return Camera(
        name, width, height, rotation, product(-rotation, position), fx, fy, (width - 1) / 2, (height - 1) / 2
    )
