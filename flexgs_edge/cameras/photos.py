"""Match the photos of a scene to its cameras by name and size, and read them."""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from flexgs_edge.cameras.camera import Camera, limit_width
from flexgs_edge.cameras.lens import straightened
from flexgs_edge.errors import InputError

if TYPE_CHECKING:
    from PIL import Image


SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff")
_FORMATS = ("JPEG", "PNG", "WEBP", "TIFF")
"""What photos may hold, whatever their names. Pillow hands PostScript to Ghostscript, which runs what a file says."""
_SHOWN = 5
# Errors of Pillow for damaged files, besides OSError (the base of its errors for truncated and unknown files).
_DAMAGED = (OSError, SyntaxError, ValueError, EOFError, struct.error, OverflowError)

Size = tuple[int, int]  # Width and height in pixels


class Photos:
    """One photo for each camera; sizes are known, and pixels are read when needed.

    Made by `Photos.open` or `Photos.of_arrays`.

    `cameras`: those with photos, in the given order, scaled to the photos (and to the width limit). `paths`: the photo
    of each camera (for messages, where they are arrays). `notes`: notes on photos that were scaled or undistorted, or
    are missing, for the summary.
    """

    def __init__(
        self, paths: list[Path], cameras: list[Camera], background: np.ndarray, notes: tuple[str, ...] = ()
    ) -> None:
        self.paths, self.cameras, self.background, self.notes = paths, cameras, background, notes
        self._arrays: Sequence[np.ndarray] | None = None

    @classmethod
    def open(
        cls,
        images_dir: str | os.PathLike[str],  # folder of JPEG, PNG, WebP or TIFF files
        cameras: Sequence[Camera],  # names are file names with or without extension
        background: Sequence[float] = (0.0, 0.0, 0.0),
        max_width: int | None = None,
    ) -> Photos:
        """Find the photo of every camera, and check its size. A few cameras without photos are left out (see `notes`).

        `background`: red, green, blue in [0, 1] behind photos with an alpha channel; black by default. `max_width`:
        wider photos, and their cameras, are scaled down to this width. No limit by default. Raises `InputError` if the
        folder or half of the photos are missing, a photo is damaged, photos cannot be told apart, or sizes do not match
        the cameras.
        """
        folder = Path(images_dir)
        _refuse_bent(folder, cameras)
        found = _match(folder, cameras)
        kept = [(path, camera) for path, camera in zip(found, cameras) if path is not None]
        paths, cameras = [path for path, _ in kept], [camera for _, camera in kept]
        photos = cls._of_sizes(paths, [photo_size(path) for path in paths], cameras, background, max_width)
        if len(kept) < len(found):
            photos.notes += (
                f"{len(found) - len(kept)} of {len(found)} cameras left out: {folder} has no photo of them",
            )
        return photos

    @classmethod
    def of_arrays(
        cls,
        images: Sequence[np.ndarray],
        cameras: Sequence[Camera],
        background: Sequence[float] = (0.0, 0.0, 0.0),
        max_width: int | None = None,
    ) -> Photos:
        """Photos from memory, one a camera: [H, W, 3] u8, or [H, W, 4] with an alpha channel.

        Parameters and errors are those of `open`; the arrays are not copied.
        """
        _refuse_bent(Path("images"), cameras)
        if len(images) != len(cameras):
            raise InputError(f"images: expected {len(cameras)} photos, one a camera, found {len(images)}")
        arrays = [np.asarray(image) for image in images]
        for i, array in enumerate(arrays):
            if array.ndim != 3 or array.shape[2] not in (3, 4) or array.dtype != np.uint8 or not array.size:
                raise InputError(
                    f"images[{i}]: expected shape [H, W, 3] or [H, W, 4] of uint8, found {array.shape} {array.dtype}"
                )
        names = [Path(f"images[{i}]") for i in range(len(arrays))]
        sizes = [(array.shape[1], array.shape[0]) for array in arrays]
        photos = cls._of_sizes(names, sizes, cameras, background, max_width)
        photos._arrays = arrays
        return photos

    @classmethod
    def _of_sizes(
        cls,
        paths: list[Path],
        sizes: list[Size],
        cameras: Sequence[Camera],
        background: Sequence[float],
        max_width: int | None,
    ) -> Photos:
        scaled, note = _scale_to(sizes, paths, cameras)
        notes: tuple[str, ...] = () if note is None else (note,)
        bent = sum(camera.lens is not None for camera in cameras)
        notes += (f"lens distortion removed from {bent} photos",) if bent else ()
        if max_width is not None:
            scaled, note = limit_width(scaled, max_width)
            notes += () if note is None else (note,)
        return cls(paths, scaled, np.asarray(background, np.float32).reshape(3), notes)

    def __len__(self) -> int:
        return len(self.paths)

    def load(self, index: int) -> np.ndarray:
        """Read the photo of camera `index`: [H, W, 3] f32 in [0, 1], at the camera's size.

        Raises `InputError` if the photo is damaged, or its kind of pixels has no colours in [0, 1].
        """
        from PIL import Image

        camera = self.cameras[index]
        pixels = self._decoded(index)
        if camera.lens is not None:
            own = camera.scaled(pixels.shape[1], pixels.shape[0])
            pixels = straightened(pixels, camera.lens, own.fx, own.fy, own.cx, own.cy)
        if pixels.shape[:2] == (camera.height, camera.width):
            return pixels
        # Area average in floats, so that colours are not rounded to 8 bits a second time.
        planes = [
            Image.fromarray(np.ascontiguousarray(pixels[:, :, c])).resize(
                (camera.width, camera.height), Image.Resampling.BOX
            )
            for c in range(3)
        ]
        return np.stack([np.asarray(plane, np.float32) for plane in planes], axis=2).clip(0.0, 1.0)

    def _decoded(self, index: int) -> np.ndarray:
        """[H, W, 3] f32 in [0, 1], at the photo's own size."""
        from PIL import Image

        if self._arrays is not None:
            return _colours(self._arrays[index], self.background)
        path = self.paths[index]
        try:
            with Image.open(path, formats=_FORMATS) as image:
                image.load()
                return _pixels(image, self.background, path)
        except InputError:  # a ValueError too, and said already what is wrong
            raise
        except (*_DAMAGED, Image.DecompressionBombError) as error:
            raise InputError(f"{path}: the photo cannot be decoded ({error}); is the file complete?") from error


def _refuse_bent(place: Path, cameras: Sequence[Camera]) -> None:
    bent = next((camera for camera in cameras if camera.distortion), None)
    if bent is not None:
        raise InputError(
            f"{place}: photos cannot be compared: camera {bent.name!r} has {bent.distortion}, which photos "
            "cannot be freed of here; use --images none to take the poses alone"
        )


def _match(folder: Path, cameras: Sequence[Camera]) -> list[Path | None]:
    """The photo of each camera, by name: as it is, without extension, or up to the first dot.

    None where there is none, for less than half of the cameras.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder of photos")
    deep = any("/" in camera.name for camera in cameras)
    by_name: dict[str, Path] = {}
    by_stem: dict[str, list[Path]] = {}
    by_start: dict[str, list[Path]] = {}  # the reference program keeps of a name what precedes its first dot
    for path in sorted(folder.rglob("*") if deep else folder.iterdir()):
        if path.suffix.lower() in SUFFIXES and path.is_file():
            name = path.relative_to(folder).as_posix()
            by_name[name] = path
            by_stem.setdefault(name[: -len(path.suffix)], []).append(path)
            by_start.setdefault(name.split(".")[0], []).append(path)
    found: list[Path | None] = []
    missing: list[str] = []
    for camera in cameras:
        name = camera.name
        stem = name[: -len(Path(name).suffix)] if Path(name).suffix.lower() in SUFFIXES else name
        choice = (
            [by_name[name]] if name in by_name else by_stem.get(name) or by_stem.get(stem) or by_start.get(name) or []
        )
        if len(choice) > 1:
            names = ", ".join(path.name for path in choice)
            raise InputError(
                f"{folder}: camera {name!r} has more than one photo ({names}); keep one, or use --images none"
            )
        found.append(choice[0] if choice else None)
        if not choice:
            missing.append(name)
    twins = [name for name in missing if re.search(r"#[0-9]+$", name)]
    if twins:
        raise InputError(
            f"{folder}: the photos of {len(twins)} of {len(cameras)} cameras cannot be told apart, since their file gives some "
            f"the same name: {', '.join(twins[:_SHOWN])}; use --images none to take the poses alone, or cameras whose names "
            "differ (transforms.json or a COLMAP model of the same frame)"
        )
    if 2 * len(missing) >= len(cameras):
        more = f" and {len(missing) - _SHOWN} more" if len(missing) > _SHOWN else ""
        raise InputError(
            f"{folder}: no photo for {len(missing)} of {len(cameras)} cameras: {', '.join(missing[:_SHOWN])}{more}; "
            f"expected files named after the cameras, ending in {', '.join(SUFFIXES)}; --images none leaves photos out"
        )
    return found


def photo_size(path: Path) -> Size:
    """Size in the header of a photo file; nothing is decoded."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path, formats=_FORMATS) as image:
            return image.size
    except UnidentifiedImageError as error:
        raise InputError(
            f"{path}: not a photo that can be read: expected a whole JPEG, PNG, WebP or TIFF file, found {_content(path)}"
        ) from error
    except (*_DAMAGED, Image.DecompressionBombError) as error:
        raise InputError(f"{path}: not a photo that can be read ({error})") from error


def _content(path: Path) -> str:
    """The first bytes of a file, and the format that Pillow knows by them; no reader is started."""
    from PIL import Image

    with open(path, "rb") as file:
        head = file.read(16)
    Image.init()
    tests = [(name, accept) for name, (_, accept) in Image.OPEN.items() if accept is not None and len(head) == 16]
    name = next((name for name, accept in tests if accept(head) is True), None)
    return f"{head!r} at its start" + (f", as {name} has" if name else "")


def _scale_to(sizes: list[Size], paths: list[Path], cameras: Sequence[Camera]) -> tuple[list[Camera], str | None]:
    """Scale the cameras to their photos, if one factor fits all of them."""
    factors: tuple[float, float] = (1.0, float("inf"))
    seen: dict[Size, Size] = {}
    for (width, height), path, camera in zip(sizes, paths, cameras):
        place = f"{path}: photo of {width}x{height} for camera {camera.name!r} of {camera.width}x{camera.height}"
        if width > camera.width or height > camera.height:
            raise InputError(
                f"{place}: photos may be smaller than the cameras say, never larger; check the two folders"
            )
        low = max(factors[0], camera.width / (width + 1), camera.height / (height + 1))
        high = min(factors[1], _most(camera.width, width), _most(camera.height, height))
        same = seen.setdefault((camera.width, camera.height), (width, height)) == (width, height)
        if low > high or not same:
            first = f"{paths[0]} ({sizes[0][0]}x{sizes[0][1]} for {cameras[0].width}x{cameras[0].height})"
            raise InputError(f"{place}: expected the same factor in width, height and all photos, as in {first}")
        factors = (low, high)
    scaled = [camera.scaled(*size) for camera, size in zip(cameras, sizes)]
    if all(size == (camera.width, camera.height) for camera, size in zip(cameras, sizes)):
        return list(cameras), None
    factor = cameras[0].width / sizes[0][0]
    return scaled, f"cameras scaled down {factor:.4g}x to their photos ({sizes[0][0]}x{sizes[0][1]})"


def _most(camera: int, photo: int) -> float:
    """Largest factor at which `photo` pixels come from `camera` pixels, rounded either way."""
    return camera / (photo - 1) if photo > 1 else float("inf")


def _pixels(image: Image.Image, background: np.ndarray, path: Path) -> np.ndarray:
    """Pixels of a decoded image in any usual mode of Pillow: [H, W, 3] f32 in [0, 1]."""
    mode = image.mode
    if mode == "F":
        raise InputError(f"{path}: pixels are floats; expected 8-bit or 16-bit colours")
    if mode == "I" or mode.startswith("I;16"):  # 16-bit grey: Pillow's conversion to RGB would clip at 255
        grey = np.asarray(image).astype(np.float32) / 65535.0
        return np.repeat(grey[:, :, None], 3, axis=2).clip(0.0, 1.0)
    if mode in ("RGBA", "LA", "PA", "RGBa", "La") or "transparency" in image.info:
        return _colours(np.asarray(image.convert("RGBA")), background)
    return _colours(np.asarray(image.convert("RGB")), background)


def _colours(pixels: np.ndarray, background: np.ndarray) -> np.ndarray:
    """[H, W, 3] f32 in [0, 1] of 8-bit colours ([H, W, 3 or 4]); alpha is put on the background."""
    colours = np.asarray(pixels, np.float32) / np.float32(255.0)
    if colours.shape[2] == 3:
        return colours
    alpha = colours[:, :, 3:]
    return colours[:, :, :3] * alpha + background * (1.0 - alpha)
