"""The views of a run: cameras, photos, the split into training and held-out views, and the background behind them."""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from flexgs_edge.cameras.auto import CloseUp, automatic_rig
from flexgs_edge.cameras.camera import Camera, distinct_names, limit_width, split_views
from flexgs_edge.cameras.candidates import Show
from flexgs_edge.cameras.photos import Photos
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.cameras.scene_sample import READ_ROWS
from flexgs_edge.cameras.start import StartView, start_view
from flexgs_edge.constants import FIXED_WEIGHT, SH_C0
from flexgs_edge.errors import InputError
from flexgs_edge.io.model_folder import Companions
from flexgs_edge.kernels.backend import Backend
from flexgs_edge.kernels.tested import counted_backend
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.progress import LOG, Stopwatch
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.report.run_info import ViewsInfo
from flexgs_edge.run.inputs import Options
from flexgs_edge.run.options import AUTO_CAMERAS, NO_CAMERAS, NO_PHOTOS, ViewOptions
from flexgs_edge.scene.source import MemorySource, SceneSource, some_positions

MEMORY = "memory"  # Takes the place of a path in records when cameras or photos came from memory
PLACING_BYTES = 90  # Bytes a row that are held while Gaussians are compared with those around them
WITHOUT_VIEWS = f"--cameras {NO_CAMERAS} leaves no views: leave it out for automatic ones, or give --cameras PATH"
Colour = tuple[float, float, float]

ALIKE = 0.1  # A colour is that of the background if no channel differs by more than this
MOST_SHARE = 0.1  # We take another background if more than this share of the matter has the colour of the one before
BACKGROUNDS: dict[str, Colour] = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "green": (0.0, 1.0, 0.0)}
SAMPLE_ROWS = 1 << 16
LARGEST = 0.99  # Splats larger than this quantile count as this large: a sky is not most of the matter
NEAR = 1e-3  # Near plane, in units of the scene's smallest part


@dataclass(frozen=True)
class ViewSet:
    """Views in order of name, and their split. `train`, `held_out`: indices into `cameras`."""

    cameras: list[Camera]  # in world coordinates, at the size they are drawn
    photos: Photos | None  # one photo per camera
    train: list[int]
    held_out: list[int]
    cameras_from: str  # path of the camera file, or `auto`
    images_path: Path | None  # folder of the photos
    # How automatic cameras were placed, and which views were scaled or lost their distortion.
    notes: tuple[str, ...] = ()
    near: float | None = None  # largest near plane that does not cut off what automatic views show, scene units
    close_ups: tuple[CloseUp, ...] = ()  # what shows much larger elsewhere than in automatic views
    fits_exposure: bool = True  # photos are fitted to the exposure of the original before they are compared

    @property
    def automatic(self) -> bool:
        """Whether the cameras were placed for want of others."""
        return self.cameras_from == AUTO_CAMERAS

    def start(self, source: SceneSource) -> StartView:
        """The view that a viewer starts from: `start_view` of all cameras, or of the better half of automatic ones.

        These are in order of what they add, and the last ones show what is seldom seen.
        """
        if not self.automatic:
            return start_view(self.cameras, some_positions(source))
        order = [*self.train, *self.held_out]
        return start_view(self.of(order), some_positions(source), -(-len(order) // 2))

    def of(self, indices: Sequence[int]) -> list[Camera]:
        """The cameras at `indices`."""
        return [self.cameras[i] for i in indices]


@dataclass(frozen=True)
class GivenViews:
    """Cameras and photos from memory instead of files."""

    cameras: Sequence[Camera] | None = None  # default: those that the options name, else those beside the scene
    # [H, W, 3] or [H, W, 4] u8, one per camera, in the order of `cameras`. For cameras from a file: in order of name.
    images: Sequence[np.ndarray] | None = None
    # File that the cameras were read from, so that photos beside it are found. Default: unknown.
    cameras_from: str = MEMORY

    def in_order_of_name(self) -> "GivenViews":
        """Return a copy with cameras, and their photos, in order of name; equal names are made distinct."""
        cameras, images = self.cameras or (), self.images
        if not cameras:
            raise InputError("cameras: expected at least one camera, found none")
        names = distinct_names([camera.name for camera in cameras])
        order = sorted(range(len(cameras)), key=lambda i: names[i])
        if images is not None and len(images) == len(order):  # `Photos` reports another number
            images = [images[i] for i in order]
        return replace(self, cameras=[replace(cameras[i], name=names[i]) for i in order], images=images)


def find_views(
    options: ViewOptions,  # its background must be filled in: photos with an alpha channel are blended with it
    companions: Companions,  # cameras and photos beside the scene
    source: SceneSource,  # the scene, from which automatic cameras are placed
    with_photos: bool = True,  # Also open the photos. Default: yes.
    given: GivenViews | None = None,  # Cameras and photos from memory. They go before options and files.
    budget: MemoryBudget | None = None,  # Pays for what placing automatic cameras needs. Default: one of the options.
) -> ViewSet | None:
    """Find the views of a run: from memory, from the options, beside the scene, or else generated.

    Returns `None` for `--cameras none`. Raises `InputError` if cameras or photos cannot be read or do not match.
    """
    given = given or GivenViews()
    place = options.cameras or companions.cameras or AUTO_CAMERAS
    if options.up is not None and (given.cameras is not None or place != AUTO_CAMERAS):
        found = given.cameras_from if given.cameras is not None else place
        raise InputError(
            f"--up turns automatic views, but cameras come from {found}: leave --up out, or give --cameras {AUTO_CAMERAS}"
        )
    cameras: Sequence[Camera]
    if given.cameras is not None:
        given = given.in_order_of_name()
        place, cameras = given.cameras_from, given.cameras or ()
    elif place in (NO_CAMERAS, AUTO_CAMERAS):
        if given.images is not None or options.images not in (None, NO_PHOTOS):
            words = "images" if given.images is not None else f"--images {options.images}"
            raise InputError(
                f"{words}: photos need the cameras that took them: give --cameras PATH "
                "(INRIA's cameras.json, a transforms.json or a COLMAP model)"
            )
        return None if place == NO_CAMERAS else _automatic_views(options, source, budget)
    else:
        cameras = read_cameras(place, options.ignore_distortion, options.dataparser or companions.dataparser)
    arrays = given.images if with_photos else None
    images = _images(options, companions, place) if with_photos and arrays is None else None
    bent = [camera.distortion for camera in cameras if camera.distortion is not None]
    notes: tuple[str, ...] = ()
    if bent:
        notes = (f"{len(bent)} cameras have {bent[0]}: only their poses are used",)
        if options.images is None and options.ignore_distortion:
            images = None
    background = options.background or (0.0, 0.0, 0.0)
    photos: Photos | None = None
    if arrays is not None:
        photos = Photos.of_arrays(arrays, cameras, background, options.resolution)
        images = Path(MEMORY)
    elif images is not None:
        photos = Photos.open(images, cameras, background, options.resolution)
    if photos is None:
        cameras, note = limit_width(cameras, options.resolution)
        notes += () if note is None else (note,)
    else:
        cameras, notes = photos.cameras, notes + photos.notes
    train, held_out = split_views(len(cameras), options.holdout)
    fits = options.exposure == "fit"
    return ViewSet(list(cameras), photos, train, held_out, os.fspath(place), images, notes, fits_exposure=fits)


def _automatic_views(options: ViewOptions, source: SceneSource, budget: MemoryBudget | None) -> ViewSet:
    LOG.info("placing camera views where the scene looks sharp")
    budget = budget or MemoryBudget.from_limit(options.memory_limit)
    up = None if options.up is None else np.array(options.up)
    backend = counted_backend(options.device, budget, Stopwatch())
    reading = PLACING_BYTES * min(source.count, READ_ROWS)
    try:
        budget.take("placing views", reading)
        rig = automatic_rig(source, partial(sketch, backend, budget), up=up)
        budget.give(reading)
    finally:
        backend.close()
    cameras, note = limit_width(rig.cameras, options.resolution)
    notes = (rig.note,) if note is None else (rig.note, note)
    train, held_out = split_views(len(cameras), options.holdout)
    return ViewSet(cameras, None, train, held_out, AUTO_CAMERAS, None, notes, rig.near, rig.close_ups)


def _images(options: ViewOptions, companions: Companions, place: str | Path) -> Path | None:
    if options.images == NO_PHOTOS:
        return None
    if options.images is not None:
        return Path(options.images)
    if place == MEMORY:
        return None
    # The photos beside the scene belong to the cameras beside it, not to cameras from elsewhere.
    beside = companions.cameras
    if beside is not None and Path(place).resolve() != beside.resolve():
        return None
    return companions.images


def near_enough(options: Options, views: ViewSet) -> tuple[Options, ViewSet]:
    """Bring the near plane of `options` so near that it does not cut off what automatic views show."""
    assert options.near is not None
    if views.near is None or options.near <= views.near:
        return options, views
    note = f"near plane {views.near:g} instead of {options.near:g}: the views stand that near to what they show"
    return replace(options, near=views.near), replace(views, notes=(*views.notes, note))


def views_info(views: ViewSet) -> ViewsInfo:
    """The views as a record for results. Width and height are the largest of all views."""
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


def contrasting_background(source: SceneSource, usual: Colour) -> tuple[Colour, str | None]:
    """A background that the scene stands out from: `usual` unless much of the matter has its colour.

    Before its own colour, matter could go without any picture telling. Returns the colour, and a note if it is another one.
    """
    rows = np.arange(0, source.count, max(-(-source.count // SAMPLE_ROWS), 1))
    planes = source.read(rows, ["sh_dc", "opacity_logits", "log_scales"])
    colours = planes["sh_dc"].astype(np.float64) * SH_C0 + 0.5
    logs = np.sort(np.clip(planes["log_scales"].astype(np.float64), -40, 40), axis=0)[1:].sum(axis=0)
    areas = np.exp(np.minimum(logs, np.quantile(logs, LARGEST)))
    areas /= 1 + np.exp(-np.clip(planes["opacity_logits"][0].astype(np.float64), -60, 60))

    def share(background: Colour) -> float:
        alike = np.all(np.abs(np.clip(colours, 0, 1) - np.array(background)[:, None]) <= ALIKE, axis=0)
        return float(areas[alike].sum() / max(float(areas.sum()), 1e-300))

    hidden = share(usual)
    if hidden <= MOST_SHARE:
        return usual, None
    name = next((name for name, each in BACKGROUNDS.items() if share(each) <= MOST_SHARE), "green")
    why = f"{100 * hidden:.0f} % of the matter has the colour of the background"
    return BACKGROUNDS[name], f"compared before {name}: {why}"


@contextmanager
def sketch(backend: Backend, budget: MemoryBudget, planes: dict[str, np.ndarray]) -> Iterator[Show]:
    """What shows a small scene ({field: [width, M] f32}) from any camera, while the context lasts."""
    source = MemorySource(planes)
    renderer = Renderer(backend, budget, NEAR)
    with renderer.load(source) as scene:

        def show(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
            rows, weights = renderer.shown_weights(scene, camera)
            return rows, weights / FIXED_WEIGHT

        yield show
    renderer.release()
