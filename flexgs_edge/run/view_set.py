"""The views of a run: cameras, photos, and which of them are held out."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from flexgs_edge.cameras.auto import automatic_rig
from flexgs_edge.cameras.camera import Camera, limit_width, split_views
from flexgs_edge.cameras.photos import Photos
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.errors import InputError
from flexgs_edge.io.model_folder import Companions
from flexgs_edge.report.run_info import ViewsInfo
from flexgs_edge.run.inputs import LOG
from flexgs_edge.run.options import AUTO_CAMERAS, NO_CAMERAS, NO_PHOTOS, ViewOptions
from flexgs_edge.scene.source import SceneSource

WITHOUT_VIEWS = f"--cameras {NO_CAMERAS} leaves no views: leave it out for automatic ones, or give --cameras PATH"


@dataclass(frozen=True)
class ViewSet:
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


def find_views(
    options: ViewOptions, companions: Companions, source: SceneSource, with_photos: bool = True
) -> ViewSet | None:
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
    return ViewSet(cameras, photos, train, held_out, os.fspath(place), images, notes)


def _automatic_views(options: ViewOptions, source: SceneSource) -> ViewSet:
    LOG.info("no cameras are used: making views from the scene itself")
    cameras, how = automatic_rig(source)
    cameras, note = limit_width(cameras, options.resolution)
    train, held_out = split_views(len(cameras), options.holdout)
    return ViewSet(cameras, None, train, held_out, AUTO_CAMERAS, None, (how,) if note is None else (how, note))


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


def views_info(views: ViewSet) -> ViewsInfo:
    """The record of the views; width and height are the largest."""
    return ViewsInfo(
        cameras=views.cameras_from,
        images=None if views.images_path is None else os.fspath(views.images_path),
        total=len(views.cameras),
        train=len(views.train),
        held_out=len(views.held_out),
        width=max(camera.width for camera in views.cameras),
        height=max(camera.height for camera in views.cameras),
        notes=views.notes,
    )
