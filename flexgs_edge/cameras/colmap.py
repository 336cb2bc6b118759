"""Read cameras and images of COLMAP's sparse models, binary or text; the points are not needed."""

import math
import os
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO, TypeVar

import numpy as np

from flexgs_edge.cameras.camera import Camera, distinct_names
from flexgs_edge.cameras.json_values import MAX_SIDE
from flexgs_edge.cameras.lens import Lens
from flexgs_edge.errors import FormatError, InputError
from flexgs_edge.small_matrices import rotation_matrix


@dataclass(frozen=True)
class Model:
    """A camera model of COLMAP."""

    name: str
    focals: int  # number of focal lengths at the front of the parameters, 1 or 2; the principal point follows
    count: int  # number of all parameters; those after the principal point describe the lens
    fisheye: bool = False  # the lens is no pinhole, even if its parameters are zero


MODELS: dict[int, Model] = dict(
    enumerate(
        (
            Model("SIMPLE_PINHOLE", 1, 3),
            Model("PINHOLE", 2, 4),
            Model("SIMPLE_RADIAL", 1, 4),
            Model("RADIAL", 1, 5),
            Model("OPENCV", 2, 8),
            Model("OPENCV_FISHEYE", 2, 8, True),
            Model("FULL_OPENCV", 2, 12),
            Model("FOV", 2, 5),
            Model("SIMPLE_RADIAL_FISHEYE", 1, 4, True),
            Model("RADIAL_FISHEYE", 1, 5, True),
            Model("THIN_PRISM_FISHEYE", 2, 12, True),
            Model("RAD_TAN_THIN_PRISM_FISHEYE", 2, 16, True),
        )
    )
)  # Camera models by COLMAP's model id

LENSES: dict[str, Callable[[tuple[float, ...]], Lens]] = {
    **dict.fromkeys(("SIMPLE_RADIAL", "RADIAL"), Lens),
    "OPENCV": lambda p: Lens(p[:2], (p[2], p[3])),
    "FULL_OPENCV": lambda p: Lens((*p[:2], *p[4:]), (p[2], p[3])),
    **dict.fromkeys(("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"), lambda p: Lens(p, fisheye=True)),
}
"""The lens that the parameters after the principal point describe, by the names of models whose photos can be freed of it."""
QUATERNION_TOLERANCE = 1e-2
"""Largest |norm - 1| of a quaternion. COLMAP normalises what it reads; other writers keep 4 digits or more."""
MODEL_FOLDERS = ("0", "sparse/0", "sparse", "colmap/sparse/0")
_NAME_LIMIT = 4096
_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I4d3dI")
_COUNT = struct.Struct("<Q")
_POINT_BYTES = 24
_KINDS = (".bin", ".txt")

_T = TypeVar("_T")


@dataclass(frozen=True)
class _Lens:
    """Width, height and parameters of a camera in COLMAP's sense."""

    model: Model
    width: int
    height: int
    parameters: tuple[float, ...]

    @property
    def distorted(self) -> bool:
        return self.model.fisheye or any(self.parameters[self.model.focals + 2 :])


@dataclass(frozen=True)
class _Image:
    """A posed image: quaternion w x y z and translation, world to camera."""

    quaternion: tuple[float, ...]
    translation: tuple[float, ...]
    lens: int
    name: str


def find_model(folder: Path) -> Path | None:
    """The folder of cameras and images: `folder` itself, or one of MODEL_FOLDERS in it; None if there is none."""
    for place in (folder, *(folder / inside for inside in MODEL_FOLDERS)):
        if any((place / f"{stem}{kind}").is_file() for stem in ("images", "cameras") for kind in _KINDS):
            return place
    return None


def read_colmap(path: str | os.PathLike[str], ignore_distortion: bool = False) -> list[Camera]:
    """Read a COLMAP model in the file's order; binary files go before text files.

    COLMAP's pixel centres lie at integer + 0.5, so half a pixel is subtracted from the principal point.

    `path`: the folder of the model, its parent, or the folder that holds `sparse/0`. `ignore_distortion`: take the
    poses of distorted lenses as pinholes; such cameras cannot be compared with photos. Raises `InputError` if a file is
    missing or cannot be read. Raises `FormatError` if a file breaks the format; the message names file and camera,
    image, line or byte.
    """
    folder = find_model(Path(path))
    if folder is None:
        raise InputError(
            f"{path}: no COLMAP model here: expected cameras.bin and images.bin, or cameras.txt and images.txt"
        )
    kind = next(
        (kind for kind in _KINDS if all((folder / f"{stem}{kind}").is_file() for stem in ("cameras", "images"))), None
    )
    if kind is None:
        found = ", ".join(
            sorted(p.name for p in folder.iterdir() if p.stem in ("cameras", "images") and p.suffix in _KINDS)
        )
        raise InputError(f"{folder}: expected cameras and images, both .bin or both .txt; found {found} only")
    lens_file, image_file = folder / f"cameras{kind}", folder / f"images{kind}"
    lenses = _read(lens_file, _binary_lenses if kind == ".bin" else _text_lenses)
    images = _read(image_file, _binary_images if kind == ".bin" else _text_images)
    if not images:
        raise FormatError(f"{image_file}: the model has no images")
    names = distinct_names([image.name for image in images])
    return [
        replace(_camera(image_file, lens_file, image, lenses, ignore_distortion), name=name)
        for image, name in zip(images, names)
    ]


def _read(path: Path, parse: Callable[[Path, BinaryIO, int], _T]) -> _T:
    try:
        with open(path, "rb") as file:
            return parse(path, file, os.fstat(file.fileno()).st_size)
    except OSError as error:
        raise InputError(f"{path}: cannot read the cameras ({error.strerror})") from error


def _camera(path: Path, lens_file: Path, image: _Image, lenses: dict[int, _Lens], ignore_distortion: bool) -> Camera:
    place = f"{path}: image {image.name!r}"
    if image.lens not in lenses:
        raise FormatError(f"{place}: camera {image.lens} is not in {lens_file.name} (which has {len(lenses)})")
    lens = lenses[image.lens]
    rotation = _rotation(place, image.quaternion)
    fx, fy = lens.parameters[0], lens.parameters[lens.model.focals - 1]
    cx, cy = (value - 0.5 for value in lens.parameters[lens.model.focals : lens.model.focals + 2])
    distortion = f"lens distortion (COLMAP model {lens.model.name})" if lens.distorted else None
    camera = Camera(
        image.name, lens.width, lens.height, rotation, np.array(image.translation), fx, fy, cx, cy, distortion
    )
    if distortion is None or ignore_distortion:
        return camera
    make = LENSES.get(lens.model.name)
    straight = None if make is None else camera.behind(make(lens.parameters[lens.model.focals + 2 :]))
    return camera if straight is None else straight


def _rotation(place: str, quaternion: Sequence[float]) -> np.ndarray:
    norm = math.hypot(*quaternion)
    if not abs(norm - 1) <= QUATERNION_TOLERANCE:
        raise FormatError(f"{place}: rotation: expected a unit quaternion, found one of norm {norm:.4g}")
    return rotation_matrix([value / norm for value in quaternion])


def _lens(place: str, model: Model, width: int, height: int, parameters: tuple[float, ...]) -> _Lens:
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise FormatError(f"{place}: size: expected 1 to {MAX_SIDE} pixels a side, found {width}x{height}")
    if not all(np.isfinite(parameters)):
        raise FormatError(f"{place}: parameters: expected finite numbers, found {_shown(parameters)}")
    if min(parameters[: model.focals]) <= 0:
        raise FormatError(f"{place}: focal length: expected above 0 pixels, found {_shown(parameters[: model.focals])}")
    return _Lens(model, width, height, parameters)


def _image(place: str, numbers: Sequence[float], lens: int, name: str) -> _Image:
    if not all(np.isfinite(numbers)):
        raise FormatError(f"{place}: pose: expected finite numbers, found {_shown(numbers)}")
    if not name.strip():
        raise FormatError(f"{place}: name: expected the photo's file name, found {name!r}")
    return _Image(tuple(numbers[:4]), tuple(numbers[4:7]), lens, name.replace("\\", "/"))


def _shown(numbers: Sequence[float]) -> str:
    return ", ".join(f"{value:g}" for value in numbers)


class _Bytes:
    """Reads a binary file piece by piece, and checks each claimed size against the file before anything is allocated."""

    def __init__(self, path: Path, file: BinaryIO, size: int) -> None:
        self.path, self.file, self.size, self.at = path, file, size, 0

    def take(self, count: int, what: str) -> bytes:
        if count > self.size - self.at:
            raise FormatError(
                f"{self.path}: truncated at byte {self.size}: {what} takes {count} bytes from byte {self.at} on"
            )
        data = self.file.read(count)
        if len(data) < count:
            raise FormatError(f"{self.path}: truncated while being read, at byte {self.at}")
        self.at += count
        return data

    def numbers(self, layout: struct.Struct, what: str) -> tuple[float, ...]:
        return layout.unpack(self.take(layout.size, what))

    def count(self, smallest: int, what: str) -> int:
        (count,) = _COUNT.unpack(self.take(_COUNT.size, f"the number of {what}"))
        if count > (self.size - self.at) // smallest:
            raise FormatError(
                f"{self.path}: {count} {what} of {smallest} bytes and more each, but only {self.size - self.at} bytes follow"
            )
        return int(count)

    def name(self, what: str) -> bytes:
        found = self.file.read(min(_NAME_LIMIT, self.size - self.at))
        end = found.find(b"\0")
        if end < 0:
            raise FormatError(
                f"{self.path}: {what}: expected a name of at most {_NAME_LIMIT - 1} bytes that ends in a zero byte"
            )
        self.at += end + 1
        self.file.seek(self.at)
        return found[:end]

    def skip(self, count: int) -> None:
        self.at += count
        self.file.seek(self.at)

    def end(self, what: str) -> None:
        if self.at != self.size:
            raise FormatError(f"{self.path}: {self.size - self.at} bytes too many after the last {what}")


def _binary_lenses(path: Path, file: BinaryIO, size: int) -> dict[int, _Lens]:
    data = _Bytes(path, file, size)
    lenses: dict[int, _Lens] = {}
    for index in range(data.count(_CAMERA.size + 3 * 8, "cameras")):
        key, model_id, width, height = (int(value) for value in data.numbers(_CAMERA, f"camera {index}"))
        place = f"{path}: camera {key}"
        model = MODELS.get(model_id)
        if model is None:
            raise FormatError(_unknown(place, str(model_id)))
        layout = struct.Struct(f"<{model.count}d")
        _add(place, lenses, key, _lens(place, model, width, height, data.numbers(layout, f"camera {index}")))
    data.end("camera")
    return lenses


def _binary_images(path: Path, file: BinaryIO, size: int) -> list[_Image]:
    data = _Bytes(path, file, size)
    images: list[_Image] = []
    for index in range(data.count(_IMAGE.size + 1 + _COUNT.size, "images")):
        what = f"image {index}"
        key, *pose, lens = data.numbers(_IMAGE, what)
        place = f"{path}: image {int(key)}"
        images.append(_image(place, pose, int(lens), _decoded(place, data.name(what))))
        data.skip(_POINT_BYTES * data.count(_POINT_BYTES, f"points of {what}"))
    data.end("image")
    return images


def _text_lenses(path: Path, file: BinaryIO, size: int) -> dict[int, _Lens]:
    lenses: dict[int, _Lens] = {}
    for place, line in _lines(path, file):
        words = _decoded(place, line).split()
        if len(words) < 4:
            raise FormatError(
                f"{place}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMETERS, found {' '.join(words)[:80]!r}"
            )
        model = next((model for model in MODELS.values() if model.name == words[1]), None)
        if model is None:
            raise FormatError(_unknown(place, words[1][:40]))
        key, width, height = (_whole(place, word) for word in (words[0], *words[2:4]))
        if len(words) != 4 + model.count:
            raise FormatError(f"{place}: model {model.name} has {model.count} parameters, found {len(words) - 4}")
        _add(place, lenses, key, _lens(place, model, width, height, _floats(place, words[4:])))
    return lenses


def _text_images(path: Path, file: BinaryIO, size: int) -> list[_Image]:
    images: list[_Image] = []
    for place, line in _lines(path, file):
        # The name is the rest of the line, since it may contain spaces.
        words = _decoded(place, line).split(maxsplit=9)
        if len(words) != 10:
            raise FormatError(
                f"{place}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, found {' '.join(words)[:80]!r}"
            )
        _whole(place, words[0])
        images.append(_image(place, _floats(place, words[1:8]), _whole(place, words[8]), words[9].rstrip()))
        # Each image has a line of points, which may be empty; the last image may lack it.
        points = len(file.readline().split())
        if points % 3:
            raise FormatError(
                f"{place}: the next line has {points} words, expected X Y POINT3D_ID of each point of this image"
            )
    return images


def _lines(path: Path, file: BinaryIO) -> Iterator[tuple[str, bytes]]:
    """Yield lines that are neither empty nor comments, with their places."""
    while line := file.readline():
        if line.strip() and not line.lstrip().startswith(b"#"):
            yield f"{path}: the line at byte {file.tell() - len(line)}", line


def _unknown(place: str, model: str) -> str:
    return (
        f"{place}: unknown camera model {model}; expected one of {', '.join(known.name for known in MODELS.values())}"
    )


def _add(place: str, lenses: dict[int, _Lens], key: int, lens: _Lens) -> None:
    if key in lenses:
        raise FormatError(f"{place}: a second camera {key}")
    lenses[key] = lens


def _decoded(place: str, text: bytes) -> str:
    try:
        return text.decode()
    except UnicodeDecodeError:
        raise FormatError(f"{place}: expected text in UTF-8, found {text[:80]!r}") from None


def _whole(place: str, word: str) -> int:
    if not (word.isascii() and word.isdigit() and len(word) <= 18):
        raise FormatError(f"{place}: expected a whole number, found {word[:40]!r}")
    return int(word)


def _floats(place: str, words: Sequence[str]) -> tuple[float, ...]:
    try:
        return tuple(float(word) for word in words)
    except ValueError as error:
        raise FormatError(f"{place}: expected numbers, found {' '.join(words)[:80]!r}") from error
