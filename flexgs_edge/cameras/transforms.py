"""Read transforms.json of NeRF and nerfstudio: poses camera to world in OpenGL's axes, and intrinsics.

Poses are taken as they stand in the file. nerfstudio writes `dataparser_transforms.json` beside a trained model. If it
is found (`find_dataparser`) or given, we move the poses into the frame of the training, which is also the frame of an
exported PLY.
"""

from __future__ import annotations

import math
import posixpath
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from flexgs_edge.cameras.camera import Camera, distinct_names
from flexgs_edge.cameras.json_values import Entry, kind, load_json
from flexgs_edge.cameras.lens import Lens
from flexgs_edge.cameras.nerfstudio import FLIP, find_dataparser, rigid
from flexgs_edge.cameras.photos import SUFFIXES, photo_size
from flexgs_edge.errors import FormatError, InputError
from flexgs_edge.progress import LOG
from flexgs_edge.small_matrices import product

DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE")  # Values of `camera_model` without a lens
BENT = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
"""Values of `camera_model` that are pinholes if their parameters are zero."""


def cameras_of_frames(
    path: Path, value: Any, ignore_distortion: bool = False, dataparser: Path | None = None
) -> list[Camera]:
    """Cameras of the JSON of a transforms.json, in its order.

    Names are the frames' `file_path`, without the folder that all of them share. Pixel centres of the file lie at
    integer + 0.5, so half a pixel is subtracted from the principal point; by default it is the image's middle. If the
    size is missing, it is taken from the frame's photo (`file_path` with or without extension).

    `ignore_distortion`: take the poses of distorted lenses as pinholes; such cameras cannot be compared with photos.
    `dataparser`: a `dataparser_transforms.json`. Default: the one that is found. Raises `InputError` if a size is not
    found. Raises `FormatError` if the file breaks its format; the message names file, frame and key.
    """
    top = Entry(str(path), value)
    frames = top.get("frames")
    if not isinstance(frames, list) or not frames:
        raise top.fail("frames", "a list of frames", "an empty one" if frames == [] else kind(frames))
    entries = [Entry(f"{path}: frame {index}", frame) for index, frame in enumerate(frames)]
    paths = [_file_path(entry) for entry in entries]
    names = distinct_names(_without_shared_folder(paths))
    frame_change = _Similarity.of(dataparser or find_dataparser(path), top)
    return [
        _camera(path, top, entry, file_path, name, frame_change, ignore_distortion)
        for entry, file_path, name in zip(entries, paths, names)
    ]


def _file_path(entry: Entry) -> str:
    # Files made on Windows have backslashes.
    return posixpath.normpath(entry.name("file_path").replace("\\", "/"))


def _without_shared_folder(paths: list[str]) -> list[str]:
    folders = [PurePosixPath(path).parent.parts for path in paths]
    shared = 0
    while all(len(folder) > shared for folder in folders) and len({folder[shared] for folder in folders}) == 1:
        shared += 1
    return [PurePosixPath(*PurePosixPath(path).parts[shared:]).as_posix() for path in paths]


@dataclass(frozen=True)
class _Similarity:
    """The map x' = scale * (linear @ x + shift)."""

    linear: np.ndarray
    shift: np.ndarray
    scale: float

    @classmethod
    def of(cls, place: Path | None, top: Entry) -> _Similarity:
        """The map from the file's frame to the training's; the identity if there is no dataparser_transforms.json."""
        if place is None:
            return cls(np.eye(3), np.zeros(3), 1.0)
        LOG.info("poses moved into the frame of the training by %s", place)
        entry = Entry(str(place), load_json(place))
        linear, shift = rigid(entry, "transform")
        scale = entry.finite("scale", "a factor above 0")
        if scale <= 0:
            raise entry.fail("scale", "a factor above 0", f"{scale:g}")
        # nerfstudio's `transform` and `scale` start at the frame of the original capture, but our poses come after
        # `applied_*`.
        if top.has("applied_transform"):
            applied, moved = rigid(top, "applied_transform")
            linear = product(linear, applied.T)
            shift = shift - product(linear, moved)
        if top.has("applied_scale"):
            applied_scale = top.finite("applied_scale", "a factor above 0")
            if applied_scale <= 0:
                raise top.fail("applied_scale", "a factor above 0", f"{applied_scale:g}")
            scale /= applied_scale
        return cls(linear, shift, scale)

    def moved(self, turn: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Move a pose (camera to world)."""
        return product(self.linear, turn), self.scale * (product(self.linear, position) + self.shift)


def _camera(
    path: Path, top: Entry, frame: Entry, file_path: str, name: str, frame_change: _Similarity, ignore_distortion: bool
) -> Camera:
    distortion = _distortion(top, frame)
    turn, position = frame_change.moved(*rigid(frame, "transform_matrix"))
    rotation = product(FLIP, turn.T)
    width, height = _size(path, top, frame, file_path)
    fx, fy = _focals(top, frame, width, height)
    cx, cy = (
        _holder(top, frame, key).finite(key, "a principal point in pixels") - 0.5
        if _has(top, frame, key)
        else (side - 1) / 2
        for key, side in (("cx", width), ("cy", height))
    )
    camera = Camera(name, width, height, rotation, product(-rotation, position), fx, fy, cx, cy, distortion)
    if distortion is None or ignore_distortion:
        return camera
    straight = camera.behind(_lens(top, frame))
    return camera if straight is None else straight


def _lens(top: Entry, frame: Entry) -> Lens:
    found = {k: _holder(top, frame, k).finite(k, "a finite number") if _has(top, frame, k) else 0.0 for k in DISTORTION}
    if "FISHEYE" in _model(top, frame):
        return Lens(tuple(found[f"k{i}"] for i in range(1, 5)), fisheye=True)
    return Lens(tuple(found[f"k{i}"] for i in range(1, 7)), (found["p1"], found["p2"]))


def _has(top: Entry, frame: Entry, key: str) -> bool:
    return frame.has(key) or top.has(key)


def _holder(top: Entry, frame: Entry, key: str) -> Entry:
    """The entry that has a key: the frame, else the whole file."""
    return frame if frame.has(key) else top


def _model(top: Entry, frame: Entry) -> str:
    """The `camera_model`, by default OPENCV."""
    model = "OPENCV"
    if _has(top, frame, "camera_model"):
        model = _holder(top, frame, "camera_model").name("camera_model")
    if _has(top, frame, "is_fisheye") and _holder(top, frame, "is_fisheye").get("is_fisheye"):
        model = "OPENCV_FISHEYE"
    return model


def _distortion(top: Entry, frame: Entry) -> str | None:
    """The distortion of the lens, for messages; None for a pinhole. Raises for models that no pinhole resembles."""
    model = _model(top, frame)
    if model not in (*PINHOLES, *BENT):
        if "FISHEYE" not in model:
            raise InputError(f"{frame.place}: camera_model: expected PINHOLE or OPENCV, found {model!r}")
        return f"lens distortion (camera_model {model})"
    found = []
    for key in DISTORTION:
        if _has(top, frame, key):
            value = _holder(top, frame, key).finite(key, "a finite number")
            if value != 0:
                found.append(f"{key} = {value:g}")
    return f"lens distortion ({', '.join(found)})" if found else None


def _size(path: Path, top: Entry, frame: Entry, file_path: str) -> tuple[int, int]:
    if _has(top, frame, "w") and _has(top, frame, "h"):
        return _holder(top, frame, "w").side("w"), _holder(top, frame, "h").side("h")
    photo = path.parent / file_path
    for place in (photo, *(photo.with_name(photo.name + suffix) for suffix in SUFFIXES)):
        if place.is_file():
            return photo_size(place)
    raise FormatError(
        f"{frame.place}: no size: expected keys 'w' and 'h', or the photo {photo} ({', '.join(SUFFIXES)})"
    )


def _focals(top: Entry, frame: Entry, width: int, height: int) -> tuple[float, float]:
    """Focal lengths in pixels, from lengths or angles; if one is missing, the other stands for both."""
    found = [_focal(top, frame, axis, side) for axis, side in (("x", width), ("y", height))]
    across, down = found
    if across is None and down is None:
        raise FormatError(
            f"{frame.place}: no focal length: expected 'fl_x' or 'camera_angle_x', there or for all frames"
        )
    first = across if across is not None else down
    assert first is not None
    return (first if across is None else across), (first if down is None else down)


def _focal(top: Entry, frame: Entry, axis: str, side: int) -> float | None:
    for holder in (frame, top):
        if holder.has(f"fl_{axis}"):
            return holder.focal(f"fl_{axis}")
    for holder in (frame, top):
        key = f"camera_angle_{axis}"
        if holder.has(key):
            angle = holder.finite(key, "an angle between 0 and pi")
            if not 0 < angle < math.pi:
                raise holder.fail(key, "an angle between 0 and pi", f"{angle:g}")
            return side / 2 / math.tan(angle / 2)
    return None
