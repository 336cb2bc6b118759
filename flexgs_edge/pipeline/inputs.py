"""From paths to a checked scene with its views: what was given, and what lies beside it."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import flexgs_edge.codec
import flexgs_edge.formats  # noqa: F401  (both register readers)
from flexgs_edge.cameras import Camera, Photos, limit_width, read_cameras, split_views
from flexgs_edge.cameras.auto import automatic_rig
from flexgs_edge.constants import DEFAULT_NEAR
from flexgs_edge.errors import InputError
from flexgs_edge.pipeline.options import AUTO_CAMERAS, NO_CAMERAS, NO_PHOTOS, ViewOptions
from flexgs_edge.scene import Companions, SceneSource, check_scene, inria_dtype, open_scene

Options = TypeVar("Options", bound=ViewOptions)

LOG = logging.getLogger("flexgs_edge")

WITHOUT_VIEWS = f"--cameras {NO_CAMERAS} leaves no views: leave it out for automatic ones, or give --cameras PATH"


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
        Of a `.fgs`; of other files what they say about drawing (`antialiased` in a `.spz`), mostly nothing.
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
    cameras_from : str
        Path of their file, or `auto`.
    images_path : Path or None
        Where the photos came from.
    notes : tuple of str
        How an automatic rig was made; what was scaled.
    """

    cameras: list[Camera]
    photos: Photos | None
    train: list[int]
    held_out: list[int]
    cameras_from: str
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
    """Options with all that drawing needs filled in: as given, else as the files say, else the defaults."""
    stored = scene.settings
    background = options.background
    if background is None:
        white = (1.0, 1.0, 1.0) if companions.white_background else (0.0, 0.0, 0.0)
        background = _background(stored.get("background"), white)
    near = options.near
    if near is None:
        found = stored.get("near")
        near = float(found) if isinstance(found, (int, float)) and found > 0 else DEFAULT_NEAR
    antialiased = options.antialiased
    if antialiased is None:
        found = stored.get("antialiased", companions.antialiased)
        antialiased = found if isinstance(found, bool) else False
        if antialiased:
            LOG.info("drawn antialiased, as %s says", "the file" if "antialiased" in stored else "cfg_args")
    extent = options.extent or stored.get("extent") or "exact"
    return replace(options, near=near, background=background, extent=extent, antialiased=antialiased)


def _background(value: object, default: tuple[float, float, float]) -> tuple[float, float, float]:
    if isinstance(value, list) and len(value) == 3 and all(isinstance(v, (int, float)) and 0 <= v <= 1 for v in value):
        return (float(value[0]), float(value[1]), float(value[2]))
    return default


def find_views(
    options: ViewOptions, companions: Companions, source: SceneSource, with_photos: bool = True
) -> Views | None:
    """The views that the options or the files beside the scene give, else an automatic rig; `None` for `--cameras none`.

    `options` must have its background filled in (photos with an alpha channel are put on it).
    """
    place = options.cameras or companions.cameras or AUTO_CAMERAS
    if place in (NO_CAMERAS, AUTO_CAMERAS):
        if options.images not in (None, NO_PHOTOS):
            raise InputError(
                f"--images {options.images}: photos need the cameras that took them: give --cameras PATH "
                "(INRIA's cameras.json, a transforms.json or a COLMAP model)"
            )
        return None if place == NO_CAMERAS else _automatic_views(options, source)
    cameras = read_cameras(place, options.ignore_distortion)
    images = _images(options, companions) if with_photos else None
    bent = sum(camera.distortion is not None for camera in cameras)
    notes: tuple[str, ...] = ()
    if bent:
        notes = (f"lens distortion of {bent} cameras ignored: only their poses are used",)
        if options.images is None:
            images = None
    photos: Photos | None = None
    if images is None:
        cameras, note = limit_width(cameras, options.resolution)
        notes += () if note is None else (note,)
    else:
        photos = Photos.open(images, cameras, options.background or (0.0, 0.0, 0.0), options.resolution)
        cameras, notes = photos.cameras, notes + photos.notes
    train, held_out = split_views(len(cameras), options.holdout)
    return Views(cameras, photos, train, held_out, os.fspath(place), images, notes)


def _automatic_views(options: ViewOptions, source: SceneSource) -> Views:
    LOG.info("no cameras are used: making views from the scene itself")
    cameras, how = automatic_rig(source)
    cameras, note = limit_width(cameras, options.resolution)
    train, held_out = split_views(len(cameras), options.holdout)
    return Views(cameras, None, train, held_out, AUTO_CAMERAS, None, (how,) if note is None else (how, note))


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
    """Cameras and photos of one place (`first` where it has cameras), background and antialiasing of either."""
    chosen = first if first.cameras is not None else second
    white = first.white_background if first.white_background is not None else second.white_background
    antialiased = first.antialiased if first.antialiased is not None else second.antialiased
    return Companions(chosen.cameras, chosen.images, white, antialiased)
