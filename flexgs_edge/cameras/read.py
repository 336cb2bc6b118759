"""Read a camera file of any supported kind; the cameras are sorted by name."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

from flexgs_edge.cameras.camera import Camera, distinct_names
from flexgs_edge.cameras.colmap import find_model, read_colmap
from flexgs_edge.cameras.json_values import Entry, kind, load_json
from flexgs_edge.cameras.nerfstudio import cameras_of_poses, is_pose_list
from flexgs_edge.cameras.transforms import cameras_of_frames
from flexgs_edge.errors import FormatError, InputError
from flexgs_edge.small_matrices import product

NERF_SYNTHETIC = "transforms_train.json"
JSON_NAMES = ("cameras.json", "transforms.json", NERF_SYNTHETIC)
SUPPORTED = (
    "INRIA's cameras.json (any .json file with a list of cameras), NeRF's or nerfstudio's transforms.json, "
    "a list of poses of ns-export cameras, "
    "a COLMAP model (cameras and images, .bin or .txt), or a folder that holds one of them"
)


def cameras_of_list(path: Path, entries: Any) -> list[Camera]:
    """Cameras of the list in INRIA's cameras.json, in its order.

    The file has no principal point, so it is the middle of the image: (W - 1) / 2, with integer pixel centres.
    The reference program drops folders and what follows the first dot from names: equal ones get `#` and their place.

    Raises `FormatError` if it is not a list, empty, or an entry is wrong; the message names file, entry and field.
    """
    if not isinstance(entries, list):
        hint = "; this looks like a NeRF transforms.json" if isinstance(entries, dict) and "frames" in entries else ""
        raise FormatError(f"{path}: expected a JSON list of cameras, found {kind(entries)}{hint}")
    if not entries:
        raise FormatError(f"{path}: the list of cameras is empty")
    cameras = [_camera(Entry(f"{path}: camera {index}", entry)) for index, entry in enumerate(entries)]
    names = distinct_names([camera.name for camera in cameras])
    return [replace(camera, name=name) for camera, name in zip(cameras, names)]


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


def find_cameras(folder: str | os.PathLike[str]) -> Path | None:
    """The camera file in a folder: one of JSON_NAMES in their order, else the folder of a COLMAP model, else None."""
    place = Path(folder)
    for name in JSON_NAMES:
        if (place / name).is_file():
            return place / name
    return find_model(place)


def read_cameras(
    path: str | os.PathLike[str],
    ignore_distortion: bool = False,  # take the poses of distorted lenses; such cameras cannot be compared with photos
    dataparser: str | os.PathLike[str] | None = None,
) -> list[Camera]:
    """Read cameras from a file or folder, sorted by name.

    `path`: INRIA's cameras.json, a transforms.json, a file of a COLMAP model, or a folder that holds one of these (a
    COLMAP model also in its `sparse/0` or `colmap/sparse/0`). `dataparser`: nerfstudio's `dataparser_transforms.json`,
    for a transforms.json. Default: the one that is found. Raises `InputError` if the path is missing or of an unknown
    kind. Raises `FormatError` if the file breaks its format.
    """
    place = Path(path)
    if place.is_dir():
        found = find_cameras(place)
        if found is None:
            raise InputError(
                f"{path}: no {', '.join(JSON_NAMES)} or COLMAP model in this folder; supported: {SUPPORTED}"
            )
        place = found
    if not place.exists():
        raise InputError(f"{path}: no such camera file; supported: {SUPPORTED}")
    if place.is_dir():
        cameras = read_colmap(place, ignore_distortion)
    elif place.name in ("cameras.bin", "images.bin", "cameras.txt", "images.txt"):
        cameras = read_colmap(place.parent, ignore_distortion)
    elif place.suffix.lower() == ".json":
        value = load_json(place)
        if isinstance(value, dict) and "frames" in value:
            moved = None if dataparser is None else Path(dataparser)
            cameras = cameras_of_frames(place, value, ignore_distortion, moved)
        elif is_pose_list(value):
            cameras = cameras_of_poses(place, value, _lenses_beside(place))
        else:
            cameras = cameras_of_list(place, value)
    else:
        raise InputError(f"{path}: unknown kind of camera file; supported: {SUPPORTED}")
    return sorted(cameras, key=lambda camera: camera.name)


def _lenses_beside(place: Path) -> list[Camera]:
    """The cameras of another file beside a list of poses, for their lenses; without photos, if these lenses are bent."""
    names = (name for name in ("transforms.json", "cameras.json") if name != place.name)
    beside = next((place.with_name(name) for name in names if place.with_name(name).is_file()), None)
    return [] if beside is None else read_cameras(beside, ignore_distortion=True)
