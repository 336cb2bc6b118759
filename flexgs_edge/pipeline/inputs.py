"""From paths to a checked scene with its views: what was given, and what lies beside it."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import flexgs_edge.codec
import flexgs_edge.formats  # noqa: F401  (both register readers)
from flexgs_edge.cameras import Camera, Photos, limit_width, read_cameras, split_views
from flexgs_edge.constants import DEFAULT_NEAR
from flexgs_edge.errors import InputError
from flexgs_edge.pipeline.options import NO_PHOTOS, ViewOptions
from flexgs_edge.scene import Companions, SceneSource, check_scene, find_companions, inria_dtype, open_scene

Options = TypeVar("Options", bound=ViewOptions)

LOG = logging.getLogger("flexgs_edge")

NO_CAMERAS = (
    "no cameras: give --cameras PATH (INRIA's cameras.json, or a folder that holds one), "
    "or put cameras.json beside the scene"
)


@dataclass(frozen=True)
class Scene:
    """A checked scene and what its file says about drawing it.

    Parameters
    ----------
    path : Path
        As given.
    source : SceneSource
        Finite, not empty.
    input_count : int
        Gaussians in the file, before any were left out.
    settings : dict
        Of a `.fgs`; empty for other files.
    """

    path: Path
    source: SceneSource
    input_count: int
    settings: dict[str, Any]

    @property
    def ply_bytes(self) -> int:
        """Bytes of the scene's PLY as INRIA writes it, with normals (248 a Gaussian at SH degree 3)."""
        return self.input_count * inria_dtype(self.source.sh_degree).itemsize

    @property
    def ply_bytes_without_normals(self) -> int:
        """The same without the three normals that nobody reads."""
        return self.ply_bytes - 12 * self.input_count


@dataclass(frozen=True)
class Views:
    """Views in order of name, and how they are split.

    Parameters
    ----------
    cameras : list of Camera
        World coordinates, at the size they are drawn.
    photos : Photos or None
        One a camera.
    train, held_out : list of int
        Indices into `cameras`.
    cameras_path, images_path : Path or None
        Where they came from.
    notes : tuple of str
        What was scaled.
    """

    cameras: list[Camera]
    photos: Photos | None
    train: list[int]
    held_out: list[int]
    cameras_path: Path
    images_path: Path | None
    notes: tuple[str, ...] = ()

    def of(self, indices: Sequence[int]) -> list[Camera]:
        """The cameras at `indices`."""
        return [self.cameras[i] for i in indices]


def read_scene(path: str | Path, drop_invalid: bool = False) -> SceneSource:
    """A checked scene from a scene file or a model folder: finite values, at least one Gaussian; read lazily."""
    return load_scene(path, drop_invalid).source


def load_scene(path: str | Path, drop_invalid: bool = False) -> Scene:
    """Open a scene and check every value of it once (raises `InputError` for what cannot be used)."""
    opened = open_scene(path)
    settings = dict(getattr(opened, "settings", {}))
    return Scene(Path(path), check_scene(opened, drop_invalid), opened.count, settings)


def resolve_drawing(options: Options, scene: Scene, companions: Companions) -> Options:
    """Options with near plane, background and extent filled in: as given, else as the files say, else the defaults."""
    stored = scene.settings
    background = options.background
    if background is None:
        white = (1.0, 1.0, 1.0) if companions.white_background else (0.0, 0.0, 0.0)
        background = _background(stored.get("background"), white)
    near = options.near
    if near is None:
        found = stored.get("near")
        near = float(found) if isinstance(found, (int, float)) and found > 0 else DEFAULT_NEAR
    return replace(options, near=near, background=background, extent=options.extent or stored.get("extent") or "exact")


def _background(value: object, default: tuple[float, float, float]) -> tuple[float, float, float]:
    if isinstance(value, list) and len(value) == 3 and all(isinstance(v, (int, float)) and 0 <= v <= 1 for v in value):
        return (float(value[0]), float(value[1]), float(value[2]))
    return default


def find_views(options: ViewOptions, companions: Companions, with_photos: bool = True) -> Views | None:
    """The views that the options or the files beside the scene give; `None` when there are no cameras at all.

    `options` must have its background filled in (photos with an alpha channel are put on it).
    """
    place = options.cameras or companions.cameras
    if place is None:
        if options.images not in (None, NO_PHOTOS):
            raise InputError(f"--images {options.images}: photos need cameras; {NO_CAMERAS}")
        return None
    cameras = read_cameras(place)
    images = _images(options, companions) if with_photos else None
    photos: Photos | None = None
    notes: tuple[str, ...]
    if images is None:
        cameras, note = limit_width(cameras, options.resolution)
        notes = () if note is None else (note,)
    else:
        photos = Photos.open(images, cameras, options.background or (0.0, 0.0, 0.0), options.resolution)
        cameras, notes = photos.cameras, photos.notes
    train, held_out = split_views(len(cameras), options.holdout)
    return Views(cameras, photos, train, held_out, Path(place), images, notes)


def _images(options: ViewOptions, companions: Companions) -> Path | None:
    if options.images == NO_PHOTOS:
        return None
    if options.images is not None:
        return Path(options.images)
    # Cameras from elsewhere need not be the ones that the photos beside the scene belong to.
    given, beside = options.cameras, companions.cameras
    if given is not None and beside is not None and Path(given).resolve() != beside.resolve():
        return None
    return companions.images


def merge_companions(first: Companions, second: Companions) -> Companions:
    """Cameras and photos of one place (`first` where it has cameras), the background of either."""
    chosen = first if first.cameras is not None else second
    white = first.white_background if first.white_background is not None else second.white_background
    return Companions(chosen.cameras, chosen.images, white)


def companions_of(path: str | Path) -> Companions:
    """What lies beside the scene at `path`; logged, so that nobody wonders where cameras came from."""
    found = find_companions(path)
    for what, place in (("cameras", found.cameras), ("photos", found.images)):
        if place is not None:
            LOG.info("found %s beside the scene: %s", what, place)
    return found
