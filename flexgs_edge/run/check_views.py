"""Check that the views belong to the scene, before anything is decided by them.

A picture that never matched its photo loses nothing by becoming grey. So a few views are drawn small and compared with their
photos, and with those of their neighbours. Without photos the renders must show something.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.conventions import other_conventions
from flexgs_edge.errors import InputError
from flexgs_edge.io.frames import RDF, Frame
from flexgs_edge.progress import LOG
from flexgs_edge.quality.psnr import mse, psnr
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.run.inputs import Options
from flexgs_edge.run.quality_evaluator import work_bytes
from flexgs_edge.run.run import Run
from flexgs_edge.run.view_set import ViewSet

RUNS, RUN = 5, 3  # Views are compared in at most so many runs, evenly spread, of so many neighbours in order of name
ALIKE = 0.5
"""Least likeness of a render and its photo. Blurred, noisy and badly exposed photos have .6 and more, wrong ones .3 and less:
docs/results/tuning.md#view_likeness"""
SURE = 3.0  # Other photos fit better if they do so by this many standard errors of the mean difference
MOST_SHIFT = 8  # Photos of cameras up to so many places away are tried where a view has the wrong one
TURN_VIEWS, TURN_ROWS = 4, 1 << 28
"""Other conventions are tried on at most so many views, and on fewer where these would draw more Gaussians than this."""

_Pictures = list[np.ndarray]
SIDE = 96  # Pixels of the longer side of the pictures that are compared
FINE, COARSE = 1, 6  # Half sides of the windows of both scales, pixels
PLAIN = 0.25 / 255.0
"""A picture whose details have less than this root mean square shows nothing that could be compared."""


@dataclass(frozen=True)
class _Compared:
    """Small renders and photos of some views, [H, W, 3] f32 each."""

    indices: list[int]
    cameras: list[Camera]
    renders: _Pictures
    photos: _Pictures

    @property
    def likenesses(self) -> list[float]:
        """Likeness of each render and its own photo; NaN where neither shows anything."""
        pairs = [(details(render), details(photo)) for render, photo in zip(self.renders, self.photos, strict=True)]
        return [math.nan if a is None and b is None else likeness(a, b) for a, b in pairs]


def check_views(run: Run[Options], renderer: Renderer, trusted: bool) -> Run[Options]:
    """Compare some views with their photos (stage `check views`).

    `run`: with views. `renderer`: draws; nothing is loaded afterwards. `trusted`: warn of views that do not belong
    to the scene, and go on. Returns the run with the words among its warnings. Raises `InputError` when most views do not
    show the scene; the message names the likely cause.
    """
    views = run.seen
    if views.automatic:
        return run
    with run.clock.stage("check views"):
        found = _find_fault(run, renderer, views)
    if found is None:
        return run
    words, fatal = found
    if fatal and not trusted:
        raise InputError(f"{views.cameras_from}: {words} --trust-views goes on all the same.")
    LOG.warning("warning: %s", words)
    return replace(run, warnings=(*run.warnings, words))


def _find_fault(run: Run[Options], renderer: Renderer, views: ViewSet) -> tuple[str, bool] | None:
    """What does not fit, in words, and whether most views are concerned; `None` if all is well."""
    indices = _chosen(len(views.cameras))
    work = work_bytes(views.of(indices))
    run.budget.take("checking views", work)
    try:
        with renderer.load(run.source) as scene:
            if views.photos is None:
                return _blind(renderer, scene, views, indices)
            compared = _compare(renderer, scene, views, indices)
            likenesses = compared.likenesses
            known = [value for value in likenesses if not math.isnan(value)]
            bad = [indices[i] for i, value in enumerate(likenesses) if value < ALIKE]
            shift = _shift_of_neighbours(compared)
            if 2 * len(bad) <= len(known) and shift is None and not _masks(compared):
                words = (
                    f"{len(bad)} of {len(known)} compared views do not resemble their photo ({_names(views, bad)}). What they "
                    "lose says little. Are these photos of this scene, and sharp?"
                )
                return (words, False) if bad else None
            cause = _cause(run.scene.frame, renderer, scene, views, compared, shift)
            return f"{_misfit(compared, len(bad), len(known))} {cause}", True
    finally:
        renderer.release()
        run.budget.give(work)


def _chosen(count: int) -> list[int]:
    """Indices of the views to compare, ascending: runs of neighbours, evenly spread."""
    if count <= RUNS * RUN:
        return list(range(count))
    starts = [i * (count - RUN) // (RUNS - 1) for i in range(RUNS)]
    return sorted({start + i for start in starts for i in range(RUN)})


def _small(camera: Camera) -> Camera:
    shrink = SIDE / max(camera.width, camera.height)
    if shrink >= 1.0:
        return camera
    return camera.scaled(max(1, round(camera.width * shrink)), max(1, round(camera.height * shrink)))


def _photo(views: ViewSet, index: int) -> np.ndarray:
    from PIL import Image

    assert views.photos is not None
    camera, photo = _small(views.cameras[index]), views.photos.load(index)
    size = camera.width, camera.height
    planes = [
        Image.fromarray(np.ascontiguousarray(photo[:, :, c])).resize(size, Image.Resampling.BOX) for c in range(3)
    ]
    return np.stack([np.asarray(plane, np.float32) for plane in planes], axis=2)


def _compare(renderer: Renderer, scene: DeviceScene, views: ViewSet, indices: list[int]) -> _Compared:
    cameras = [_small(views.cameras[i]) for i in indices]
    renders = [np.clip(renderer.render(scene, camera), 0.0, 1.0) for camera in cameras]
    return _Compared(indices, cameras, renders, [_photo(views, i) for i in indices])


def _blind(renderer: Renderer, scene: DeviceScene, views: ViewSet, indices: list[int]) -> tuple[str, bool] | None:
    """Views, without photos, that show one colour: they see nothing of the scene, or stand in matter."""
    blind, inside = [], 0
    for index in indices:
        if details(renderer.render(scene, _small(views.cameras[index]))) is None:
            blind.append(index)
            inside += renderer.drawn_coverage() > 0.5
    if not blind:
        return None
    words = (
        f"{len(blind)} of {len(indices)} compared views show nothing but one colour ({_names(views, blind)}): their cameras look "
        "away from the scene, are far from it, or stand in matter. Are the cameras in the scene's frame?"
    )
    return words, 2 * inside > len(indices)


def _names(views: ViewSet, indices: Sequence[int], most: int = 3) -> str:
    more = f" and {len(indices) - most} more" if len(indices) > most else ""
    return ", ".join(views.cameras[i].name for i in indices[:most]) + more


def _misfit(compared: _Compared, bad: int, known: int) -> str:
    errors = [mse(a, b) for a, b in zip(compared.renders, compared.photos, strict=True)]
    half = len(compared.photos) // 2
    others = compared.photos[half:] + compared.photos[:half]
    turned = [mse(a, b) for a, b in zip(compared.renders, others) if a.shape == b.shape]
    own, other = psnr(float(np.median(errors))), psnr(float(np.median(turned))) if turned else None
    against = ""
    if own is not None and other is not None:
        against = f" (PSNR of the original {own:.1f} dB, with other photos {other:.1f} dB)"
    if _masks(compared):
        return f"the photos have no colours{against}."
    if 2 * bad <= known:
        return f"the photos of neighbours fit the views better than their own do{against}."
    so = "so a drop against the photos would mean nothing"
    return f"{bad} of {known} compared views do not resemble their photo{against}, {so}."


def _shift_of_neighbours(compared: _Compared) -> int | None:
    """By how many places, in order of name, photos lie off; `None` unless those of neighbours fit better for sure."""
    own = compared.likenesses
    photos = {index: details(photo) for index, photo in zip(compared.indices, compared.photos, strict=True)}
    renders = [details(render) for render in compared.renders]
    for places in (1, -1):
        gains = [
            likeness(render, photos[index + places]) - own[i]
            for i, (index, render) in enumerate(zip(compared.indices, renders, strict=True))
            if index + places in photos and not math.isnan(own[i])
        ]
        if len(gains) < RUN:
            continue
        error = float(np.std(gains, ddof=1)) / math.sqrt(len(gains))
        if np.mean(gains) > SURE * error and np.median(gains) > 0.0:
            return places
    return None


def _cause(
    frame: Frame, renderer: Renderer, scene: DeviceScene, views: ViewSet, compared: _Compared, shift: int | None
) -> str:
    """The likeliest reason, in words that a person acts on."""
    if shift is None:
        shift = _far_shift(views, compared)
    if shift is not None:
        places = "1 place" if abs(shift) == 1 else f"{abs(shift)} places"
        return (
            f"Each camera fits the photo {places} {'after' if shift > 0 else 'before'} its own in order of name: check how "
            "photos and cameras are named."
        )
    if _masks(compared):
        return "The scene has colours: are these masks or depth maps? Give the photos (--images DIR), or none (--images none)."
    turn = _fitting_convention(frame, renderer, scene, compared)
    if turn:
        return turn
    return (
        "Likely causes, in this order: the cameras are in another frame than the scene (nerfstudio: give "
        "dataparser_transforms.json beside transforms.json; COLMAP: use the model that the training read); photos of other "
        "cameras have these names; photos of another scene; masks or depth maps instead of photos."
    )


def _far_shift(views: ViewSet, compared: _Compared) -> int | None:
    """A number of places by which the photos of all compared views lie off, up to `MOST_SHIFT`."""
    middle = range(len(compared.indices))[:: max(len(compared.indices) // RUNS, 1)][:RUNS]
    count, found = len(views.cameras), []
    for at in middle:
        render, index = details(compared.renders[at]), compared.indices[at]
        near = [i for i in range(index - MOST_SHIFT, index + MOST_SHIFT + 1) if 0 <= i < count]
        values = {i - index: likeness(render, details(_photo(views, i))) for i in near}
        best = max(values, key=lambda places: values[places])
        found.append(best if values[best] >= ALIKE else 0)
    shift = max(set(found), key=found.count)
    return shift if shift and 2 * found.count(shift) > len(found) else None


def _masks(compared: _Compared) -> bool:
    """Whether the photos have no colours and the scene has."""
    return all(_grey(photo) for photo in compared.photos) and not all(_grey(render) for render in compared.renders)


def _grey(picture: np.ndarray) -> bool:
    return not np.ptp(picture, axis=2).any()


def _fitting_convention(frame: Frame, renderer: Renderer, scene: DeviceScene, compared: _Compared) -> str:
    """The convention by which most views resemble their photos, and what to do; empty if there is none."""
    conventions = list(other_conventions())
    most = min(TURN_VIEWS, max(2, TURN_ROWS // (len(conventions) * max(scene.count, 1))))
    step = max(len(compared.cameras) // most, 1)
    some = list(range(0, len(compared.cameras), step))[:most]
    photos = [details(compared.photos[i]) for i in some]
    best, words = ALIKE, ""
    for convention in conventions:
        found = []
        for i, photo in zip(some, photos, strict=True):
            camera, mirrored = convention.applied(compared.cameras[i])
            picture = renderer.render(scene, camera)
            found.append(likeness(details(picture[:, ::-1] if mirrored else picture), photo))
        fit = float(np.median(found))
        if fit > best:
            best, words = fit, f"The cameras fit if {convention.words}."
            signs = convention.signs
            if signs is not None:
                name = "".join(pair[int(sign < 0)] for pair, sign in zip(("RL", "DU", "FB"), frame.signs * signs))
                words += f" --frame {name} turns the scene into their frame."
                if frame == RDF:
                    words += " Or give the cameras that belong to it."
    return words


def details(image: np.ndarray) -> np.ndarray | None:
    """What lies between the two scales of a picture, at unit norm; `None` for a picture that shows nothing.

    Noise and fine texture are smoothed away, and so is light that changes slowly.

    `image`: [H, W, 3] f32, `SIDE` pixels on the longer side. Returns [H, W, 3] f32.
    """
    smooth = _window_mean(_window_mean(np.clip(image, 0.0, 1.0).astype(np.float64), FINE), FINE)
    found = smooth - _window_mean(smooth, COARSE)
    found -= found.mean(axis=(0, 1))
    norm = math.sqrt(float(np.square(found).sum()))
    return None if norm < PLAIN * math.sqrt(found.size) else (found / norm).astype(np.float32)


def likeness(first: np.ndarray | None, second: np.ndarray | None) -> float:
    """Correlation of the details of two pictures, -1 to 1; 0 if one of them shows nothing, or if their sizes differ.

    Pictures of the same thing are near 1. Others are near 0, also where sky and ground are alike.
    """
    if first is None or second is None or first.shape != second.shape:
        return 0.0
    return float(np.vdot(first, second))


def _window_mean(planes: np.ndarray, reach: int) -> np.ndarray:
    """Mean over windows of `2 reach + 1` pixels a side, which are cut off at the edges."""
    for axis in (0, 1):
        size = planes.shape[axis]
        first = np.maximum(np.arange(size) - reach, 0)
        behind = np.minimum(np.arange(size) + reach + 1, size)
        sums = np.concatenate([np.zeros_like(planes.take([0], axis)), planes.cumsum(axis)], axis)
        shape = [1, 1, 1]
        shape[axis] = size
        planes = (sums.take(behind, axis) - sums.take(first, axis)) / (behind - first).reshape(shape)
    return planes
