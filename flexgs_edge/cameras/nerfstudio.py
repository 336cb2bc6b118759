"""What nerfstudio writes of a training: the frame of its scene, and the list of poses of `ns-export cameras`."""

import glob
import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from flexgs_edge.cameras.camera import Camera, distinct_names
from flexgs_edge.cameras.json_values import Entry, load_json
from flexgs_edge.errors import InputError
from flexgs_edge.small_matrices import product

DATAPARSER = "dataparser_transforms.json"
LEVELS = 4  # Folders above the data, or above a PLY, that are searched
FLIP = np.diag([1.0, -1.0, -1.0])  # Turns OpenGL's camera (y up, looking along -z) into COLMAP's
ASSUMED_SIZE = (640, 480)
ASSUMED_VIEW = 65.0  # Degrees across the image, where a list of poses has no focal length
_CONFIG_LIMIT = 1 << 20  # Most bytes of config.yml that are searched for the name of the data


def find_dataparser(path: Path) -> Path | None:
    """The `dataparser_transforms.json` of the data of a transforms.json, or None.

    It lies beside the file, or in nerfstudio's `outputs/EXPERIMENT/METHOD/TIME` in the data's folder or up to LEVELS above
    it. There, the experiment or its config.yml must name the data's folder.

    Raises `InputError` if there are several that differ.
    """
    if path.with_name(DATAPARSER).is_file():
        return path.with_name(DATAPARSER)
    folder = path.absolute().parent
    for above in (folder, *folder.parents[:LEVELS]):
        names = ("*" if above == folder else glob.escape(folder.name), "*")
        found = [place for name in names for place in sorted(above.glob(f"outputs/{name}/*/*/{DATAPARSER}"))]
        own = [place for place in dict.fromkeys(found) if above == folder or _names(place, folder.name)]
        texts = [load_json(place) for place in own]
        if any(text != texts[0] for text in texts):
            raise InputError(
                f"{path}: {len(own)} trainings of it have frames that differ: {', '.join(map(str, own[:4]))}: say which one "
                "the scene comes from with --dataparser FILE"
            )
        if own:
            return own[0]
    return None


def _names(place: Path, data: str) -> bool:
    """Whether a training in `outputs` says that it used the folder `data`."""
    if place.parents[2].name == data:
        return True
    with suppress(OSError), open(place.with_name("config.yml"), "rb") as file:
        return data.encode() in file.read(_CONFIG_LIMIT).split()
    return False


def dataparser_above(scene: Path) -> Path | None:
    """The `dataparser_transforms.json` beside a scene, or up to LEVELS folders above it."""
    folder = scene.absolute() if scene.is_dir() else scene.absolute().parent
    places = (above / DATAPARSER for above in (folder, *folder.parents[:LEVELS]))
    return next((place for place in places if place.is_file()), None)


def is_pose_list(value: Any) -> bool:
    """Whether a JSON value is what `ns-export cameras` writes: a list of `file_path` and `transform`."""
    return (
        isinstance(value, list)
        and bool(value)
        and isinstance(value[0], dict)
        and {"file_path", "transform"} <= {*value[0]}
    )


def cameras_of_poses(path: Path, value: Sequence[Any], like: Sequence[Camera]) -> list[Camera]:
    """Cameras of `ns-export cameras`: poses camera to world, OpenGL's axes, in the frame of the exported PLY.

    The list has neither sizes nor focal lengths. They are taken from the camera in `like` with the same file name, or from
    all of `like` if they are equal. Without `like`, a view of ASSUMED_VIEW degrees is assumed: photos cannot be compared.

    Raises `FormatError` if an entry is wrong; the message names it. Raises `InputError` if `like` has cameras, but none
    that fits.
    """
    entries = [Entry(f"{path}: camera {index}", entry) for index, entry in enumerate(value)]
    files = [PurePosixPath(entry.name("file_path").replace("\\", "/")) for entry in entries]
    shared = {file.parent for file in files}
    names = distinct_names([file.name if len(shared) == 1 else str(file).lstrip("/") for file in files])
    by_stem = {PurePosixPath(camera.name).stem: camera for camera in like}
    lenses = {(c.width, c.height, c.fx, c.fy, c.cx, c.cy, c.distortion) for c in like}
    common = like[0] if len(lenses) == 1 else None if like else _assumed()
    cameras = []
    for entry, file, name in zip(entries, files, names):
        lens = by_stem.get(file.stem, common)
        if lens is None:
            raise InputError(
                f"{entry.place}: no size and focal length: no camera beside the list is called {file.stem!r}, and their lenses "
                "differ: put the transforms.json of the same photos beside it"
            )
        turn, position = rigid(entry, "transform")
        rotation = product(FLIP, turn.T)
        cameras.append(replace(lens, name=name, rotation=rotation, translation=product(-rotation, position)))
    return cameras


def _assumed() -> Camera:
    width, height = ASSUMED_SIZE
    focal = width / 2 / math.tan(math.radians(ASSUMED_VIEW) / 2)
    why = f"an assumed field of view of {ASSUMED_VIEW:g} degrees (put the data's transforms.json beside the list)"
    return Camera("", width, height, np.eye(3), np.zeros(3), focal, focal, (width - 1) / 2, (height - 1) / 2, why)


def rigid(entry: Entry, key: str) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and translation of a 3x4 or 4x4 matrix."""
    value = entry.get(key)
    rows = len(value) if isinstance(value, list) else 3
    matrix = entry.array(key, (4 if rows == 4 else 3, 4))
    if rows == 4 and np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise entry.fail(key, "0 0 0 1 as the last row", " ".join(f"{v:g}" for v in matrix[3]))
    entry.check_rotation(key, matrix[:3, :3])
    return matrix[:3, :3], matrix[:3, 3]
