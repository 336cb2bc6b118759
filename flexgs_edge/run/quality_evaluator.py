"""Compare a scene with renders of the original and with photos, kept in memory as far as the budget allows."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from math import log2
from typing import TypeVar

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.constants import DEFAULT_BASE_PSNR
from flexgs_edge.errors import InputError
from flexgs_edge.goals.target import Covered, Measurement, Target
from flexgs_edge.kernels.backend import Backend
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.quality.psnr import contrast, exposure_gains, far_bases, lone_base, moved_error, mse, with_gains
from flexgs_edge.quality.similarity import flip_bytes, flip_maps, flips, ssim_bytes, ssims
from flexgs_edge.quality.view_quality import Distance, Quality, ViewQuality, compare_view, with_flip
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.run.few_poses import FewPoses
from flexgs_edge.run.options import AUTO_CAMERAS
from flexgs_edge.run.view_set import ViewSet
from flexgs_edge.scene.check import alive, invisible
from flexgs_edge.scene.source import SceneSource

SHARE = 4
"""Reference images take at most one part in `SHARE` of the free budget. The scene and its views need the rest."""
LIBRARY_BYTES = 12 * 2**20
"""Bound on the bytes that loading Pillow and decoding with it take: docs/results/tuning.md#memory"""
WORK_BYTES = 100
"""Bound on the bytes per pixel while a photo is decoded, or SSIM or FLIP is computed, with the backend's buffers."""
CHECK_ROWS = 1 << 18  # Rows whose opacity is read at a time, where no view sees any Gaussian
_Pairs = Sequence[tuple[np.ndarray, np.ndarray]]
_Found = TypeVar("_Found")
ESTIMATE_STEP = 2  # An estimate reads every second pixel in both directions


def work_bytes(cameras: Sequence[Camera]) -> int:
    """Bytes that comparing the views of these cameras takes, without their reference images."""
    return LIBRARY_BYTES + WORK_BYTES * max(camera.width * camera.height for camera in cameras)


class QualityEvaluator:
    """Compares a scene with the original, and with photos, over some views.

    Without photos, the figures over covered pixels decide: background that the original leaves empty must not dilute an
    error. With photos, the plain figures decide, as everywhere else.

    `with_photos`: also compare with the photos, if there are any: at the exposure of the original, unless the run says
    otherwise. `reports`: the run reports these qualities, SSIM included. The judge then remembers them, and does not
    measure the same scene twice.
    """

    def __init__(
        self,
        renderer: Renderer,  # Draws both scenes. Kept images take at most a quarter of its free budget.
        source: SceneSource,  # The original. A reference that was not kept is drawn again.
        views: ViewSet,  # all views of the run
        indices: Sequence[int],  # the views to compare
        with_photos: bool = True,
        # Default: without photos what the original's renders tell (`lone_base`), else `DEFAULT_BASE_PSNR`, dB.
        base_psnr: float | None = None,
        reports: bool = False,
        finetuned: bool = True,  # as for `lone_base`
    ) -> None:
        self.renderer = renderer
        budget = renderer.budget
        self.source = source
        self.cameras = views.of(indices)
        self.photos = views.photos if with_photos else None
        self._fits_exposure = views.fits_exposure
        self.covered_decides = views.photos is None
        self._automatic = views.automatic
        self.base_psnr = DEFAULT_BASE_PSNR if base_psnr is None else base_psnr
        self._given_base, self._finetuned = base_psnr, finetuned
        self.reports = reports
        self.indices = list(indices)
        self._budget = budget
        self._kept: dict[tuple[str, int], np.ndarray] = {}
        self._away: dict[tuple[str, int], np.ndarray] = {}
        self._gains: list[np.ndarray | None] = []
        self._original_error: list[float] = []
        self._far_bases: list[float | None] = []
        self._original_ssim: dict[int, float | None] = {}
        self._coverage: list[float] = []
        self._coarse_error: dict[int, float] = {}
        self._known: dict[bytes, Quality] = {}
        self.made: FewPoses | None = None  # Made poses that whole comparisons look at too
        # Reserve the memory now: scenes that are loaded later must not count on it.
        images = 1 if self.photos is None else 2
        sizes = [size for camera in self.cameras for size in (camera, camera.every(ESTIMATE_STEP))]
        wanted = sum(size.width * size.height for size in sizes) * 12 * images
        self._work = work_bytes(self.cameras)
        budget.take("comparing views", self._work)
        self._reserved = min(wanted, budget.free // SHARE)
        budget.take("reference images", self._reserved)
        self._left = self._reserved
        budget.reclaimers.append(self._give_back)

    def prepare(self, scene: DeviceScene, progress: Progress = SILENT) -> None:
        """Draw the references from `scene`, the loaded original, and measure them against the photos.

        Raises `InputError` when no view sees any Gaussian.
        """
        self._original_error, self._original_ssim, self._coverage, self._gains = [], {}, [], []
        contrasts: list[float] = []
        moved: list[float] = []
        self._coarse_error, self._known = {}, {}
        cameras = progress.track(self.renderer.in_turn(scene, self.cameras), "drawing the original", len(self.cameras))
        for i, camera in enumerate(cameras):
            # Clamp once, and store channel by channel as renders do: comparisons are then much faster.
            image = _planes(self.renderer.render(scene, camera))
            self._coverage.append(self.renderer.drawn_coverage())
            self._keep(("original", i), image)
            if self.photos is None:
                moved.append(moved_error(image, camera.fx))
            else:
                photo, gains = self._fitted(i, image)
                self._gains.append(gains)
                contrasts.append(contrast(photo))
                self._original_error.append(mse(image, photo))
                self._keep(("photo", i), photo)
        if self.photos is None and self._given_base is None:
            self.base_psnr = lone_base(moved, self._coverage, self._finetuned)
        self._far_bases = far_bases(self._original_error, contrasts, self.base_psnr)
        if not any(self._coverage):
            raise self._nothing_seen()

    def _nothing_seen(self) -> InputError:
        source = self.source
        logits = (source.read(rows, ["opacity_logits"])["opacity_logits"] for rows in source.chunks(CHECK_ROWS))
        if not any(alive(part[0]).any() for part in logits):
            return invisible(source)
        placed = "" if self._automatic else f", let them be placed (--cameras {AUTO_CAMERAS})"
        return InputError(
            f"{source.name}: none of {len(self.cameras)} {'automatic ' if self._automatic else ''}views sees any Gaussian, so "
            f"nothing can be compared. Give cameras that look at the scene (--cameras PATH){placed}, or move the near plane "
            f"(--near, now {self.renderer.near:g})"
        )

    def close(self) -> None:
        """Free the kept images and the reserved memory."""
        self._kept, self._away = {}, {}
        self._budget.give(self._reserved + self._work)
        self._reserved = self._work = self._left = 0
        if self._give_back in self._budget.reclaimers:
            self._budget.reclaimers.remove(self._give_back)

    def _give_back(self, short: int) -> None:
        """Free `short` bytes: first unused reserve, then kept images.

        Images go to scratch files if the run has some; otherwise they are drawn or read again when needed.
        """
        freed = min(self._left, short)
        self._left -= freed
        while freed < short and self._kept:
            key, image = self._kept.popitem()
            freed += image.nbytes
            self._put_away(key, image)
        self._reserved -= freed
        self._budget.give(freed)

    def photos_that_decide(self, target: Target) -> Callable[[int, np.ndarray], np.ndarray] | None:
        """What loads the photo of a view, by its place and a coarse render of the original; `None` if no photos decide.

        The render has every n-th pixel of the view, and so has the photo, which is fitted to its exposure.
        """
        if self.photos is None or target.figure != "drop":
            return None
        return lambda place, image: self._fitted(place, image)[0]

    def _fitted(self, i: int, image: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """Photo of view `indices[i]` at the exposure of `image`, a render of the original, and its gains if it was changed."""
        assert self.photos is not None
        step = -(-self.cameras[i].height // image.shape[0])
        photo = _planes(self.photos.load(self.indices[i])[::step, ::step])
        gains = exposure_gains(image, photo) if self._fits_exposure else None
        return with_gains(photo, gains, image), gains

    @property
    def kept(self) -> int:
        """Number of reference renders in memory."""
        return sum(kind == "original" for kind, _ in self._kept)

    def compare(
        self,
        scene: DeviceScene,  # the loaded scene
        with_ssim: bool = False,  # also measure SSIM
        progress: Progress = SILENT,  # shows a bar
        lpips: Distance | None = None,
        flip: bool = False,  # Also measure FLIP, about as fast as SSIM. Searches do without it.
    ) -> Quality:
        """Measure the quality of `scene` over the views.

        With `reports`, a scene that equals an earlier one bit for bit returns the earlier quality without drawing.

        `lpips`: also measure LPIPS with this network. It takes far longer than drawing the views. Default: no LPIPS.
        """
        whole = self.reports and with_ssim and lpips is None
        drawn = scene.fingerprint() if whole else None
        known = self._known.get(drawn) if drawn is not None else None
        if known is not None and (known.worst_flip or not flip):
            return known
        by_ssim, by_flip = partial(self._measured, ssim_bytes, ssims), partial(self._measured, flip_bytes, flips)
        found: list[ViewQuality] = []
        images = (self.renderer.render(scene, camera) for camera in self.renderer.in_turn(scene, self.cameras))
        for i, image in enumerate(progress.track(images, "comparing views", len(self.cameras))):
            error, similar = self._original_error[i] if self.photos is not None else None, self._original_ssim.get(i)
            original = self.original(i)
            references = original, self._photo(i, original)
            if known is not None:
                found.append(with_flip(known.views[i], image, *references, by_flip))
                continue
            name, coverage = self.cameras[i].name, self._coverage[i]
            own = by_ssim if with_ssim else None, by_flip if flip else None
            found.append(compare_view(name, image, *references, error, similar, own[0], lpips, coverage, own[1]))
            if with_ssim:
                self._original_ssim[i] = found[-1].original_ssim
            found[-1] = self._as_counted(found[-1], i)
        made = None if known is None else known.made
        if known is None and self.made is not None:
            made = self.made.quality(scene)
        quality = Quality(tuple(found), self.base_psnr, self.covered_decides, made)
        if whole and drawn is None:
            drawn = scene.fingerprint()
        if drawn is not None:
            self._known[drawn] = quality
        return quality

    def estimate(self, scene: DeviceScene) -> Quality:
        """Measure PSNR on a quarter of the pixels: enough for a search to choose its next step, and faster than `compare`."""
        found = []
        few = [camera.every(ESTIMATE_STEP) for camera in self.cameras]
        for i, camera in enumerate(self.renderer.in_turn(scene, few)):
            image = self.renderer.render(scene, camera)
            view = compare_view(self.cameras[i].name, image, *self._coarse(i), coverage=self._coverage[i])
            found.append(self._as_counted(view, i))
        return Quality(tuple(found), self.base_psnr, self.covered_decides)

    def _as_counted(self, view: ViewQuality, i: int) -> ViewQuality:
        """The quality of view `indices[i]` with what its photo is worth."""
        if self.photos is None:
            return view
        gains = self._gains[i]
        exposure = None if gains is None else tuple(log2(gain) for gain in gains)
        return replace(view, far_base=self._far_bases[i], exposure=exposure)

    def _coarse(self, i: int) -> tuple[np.ndarray, np.ndarray | None, float | None]:
        """References of an estimate: original and photo at its pixels, and the mean squared error between them."""
        every = (slice(None, None, ESTIMATE_STEP),) * 2
        original, photo = self._held(("coarse original", i)), self._held(("coarse photo", i))
        if original is None:
            original = _planes(self.original(i)[every])
            self._keep(("coarse original", i), original)
        if self.photos is None:
            return original, None, None
        if photo is None:
            found = self._photo(i, self.original(i))
            assert found is not None
            photo = _planes(found[every])
            self._keep(("coarse photo", i), photo)
        if i not in self._coarse_error:
            self._coarse_error[i] = mse(original, photo)
        return original, photo, self._coarse_error[i]

    def _measured(
        self, needed: Callable[[int, int], int], measure: Callable[[Backend, _Pairs], list[_Found]], pairs: _Pairs
    ) -> list[_Found]:
        """What `measure` finds on the backend, with the bytes that it needs for pictures of this width and height."""
        height, width = pairs[0][0].shape[:2]
        with self._lent(needed(width, height)):
            return measure(self.renderer.backend, pairs)

    def flip_map(self, image: np.ndarray, reference: np.ndarray) -> np.ndarray:
        """FLIP at every pixel of two [H, W, 3] images: [H, W] f32, 0 to 1."""
        return self._measured(flip_bytes, flip_maps, [(image, reference)])[0]

    @contextmanager
    def _lent(self, wanted: int) -> Iterator[None]:
        """Give up to `wanted` bytes of the work memory back for a while: arrays on the backend take them themselves."""
        work = min(wanted, self._work)
        self._budget.give(work)
        try:
            yield
        finally:
            self._budget.take("comparing views", work)

    def images(self, scene: DeviceScene, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Render of `scene`, render of the original and photo of view `indices[i]`, each [H, W, 3] f32 in [0, 1]."""
        image, original = _planes(self.renderer.render(scene, self.cameras[i])), _planes(self.original(i))
        return image, original, self._photo(i, original)

    def _keep(self, key: tuple[str, int], image: np.ndarray) -> None:
        if image.nbytes <= self._left:
            self._left -= image.nbytes
            self._kept[key] = image
        else:
            self._put_away(key, image)

    def _put_away(self, key: tuple[str, int], image: np.ndarray) -> None:
        """Move an image to a scratch file if the run has some; otherwise drop it."""
        storage = self.renderer.storage
        if storage.spills:
            height, width, _ = image.shape
            planes = storage.copy(image.transpose(2, 0, 1).reshape(3, -1))
            self._away[key] = planes.reshape(3, height, width).transpose(1, 2, 0)

    def _held(self, key: tuple[str, int]) -> np.ndarray | None:
        return self._kept.get(key, self._away.get(key))

    def original(self, i: int) -> np.ndarray:
        """Render of the original from view `indices[i]`, [H, W, 3] f32. Drawn again if it was not kept."""
        held = self._held(("original", i))
        if held is None:
            with self.renderer.load(self.source) as scene:
                held = _planes(self.renderer.render(scene, self.cameras[i]))
            self._keep(("original", i), held)
        return held

    def _photo(self, i: int, original: np.ndarray) -> np.ndarray | None:
        """The photo of view `indices[i]` as it is compared; `original` is the original's render."""
        if self.photos is None:
            return None
        held = self._held(("photo", i))
        return with_gains(self.photos.load(self.indices[i]), self._gains[i], original) if held is None else held


def measurement_of(quality: Quality) -> Measurement:
    """The figures that a search decides on: the means, and those of the worst view."""
    worst = quality.worst
    alone = None if worst is None else _means(replace(quality, views=(worst,), made=None))
    return replace(
        _means(quality),
        worst=alone,
        usual=quality.usual_drop,
        ssim_drop=quality.ssim_drop,
        made_gap=quality.made_gap,
        losses=tuple(quality.losses),
    )


def _means(quality: Quality) -> Measurement:
    covered = Covered(quality.covered_fidelity, quality.covered_modelled_drop) if quality.covered_decides else None
    drop = None if quality.drop is None else quality.usual_drop
    return Measurement(drop, quality.fidelity, quality.modelled_drop, covered=covered)


def _planes(image: np.ndarray) -> np.ndarray:
    """Clamp [H, W, 3] to [0, 1], stored channel by channel."""
    planes = np.ascontiguousarray(image.transpose(2, 0, 1))
    np.clip(planes, 0.0, 1.0, out=planes)
    return planes.transpose(1, 2, 0)
