"""The views that judge: renders of the original and photos, kept in memory as far as the budget goes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.constants import DEFAULT_BASE_PSNR
from flexgs_edge.goals.target import Measurement
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.quality.psnr import mse
from flexgs_edge.quality.ssim import ssim_bytes, ssims
from flexgs_edge.quality.view_quality import Distance, Quality, ViewQuality, compare_view
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.run.view_set import ViewSet
from flexgs_edge.scene.source import SceneSource
from flexgs_edge.views.bench import Bench

SHARE = 4
"""Reference images may take this part of the free budget (one in four): the rest is for the scene and its views."""
LIBRARY_BYTES = 12 * 2**20
"""Bound on what Pillow takes when it is loaded and decodes: docs/results/tuning.md#memory"""
WORK_BYTES = 100
"""Bytes a pixel that decoding a photo, or SSIM, holds for a moment (32 of SSIM's are the backend's)."""
ESTIMATE_STEP = 2
"""Pixels from one to the next, in both directions, that an estimate looks at."""


class Judge:
    """Compares a scene with the original (and with photos) over some views.

    Parameters
    ----------
    bench : Bench
        Draws both; kept images are taken from its budget, at most a quarter of what is free.
    source : SceneSource
        The original; drawn again whenever a reference was not kept.
    views : ViewSet
        All views.
    indices : sequence of int
        The views that judge.
    with_photos : bool
        Compare with photos as well, where there are any.
    base_psnr : float
        For the modelled drop, dB.
    reports : bool
        Its qualities are what a run reports, SSIM and all: a search takes them whole, and a file that decodes to what the search
        measured is not measured again.
    """

    def __init__(
        self,
        bench: Bench,
        source: SceneSource,
        views: ViewSet,
        indices: Sequence[int],
        with_photos: bool = True,
        base_psnr: float = DEFAULT_BASE_PSNR,
        reports: bool = False,
    ) -> None:
        self.bench, self.renderer = bench, bench.renderer
        budget = bench.renderer.budget
        self.source = source
        self.cameras = views.of(indices)
        self.photos = views.photos if with_photos else None
        self.base_psnr = base_psnr
        self.reports = reports
        self.indices = list(indices)
        self._budget = budget
        self._kept: dict[tuple[str, int], np.ndarray] = {}
        self._away: dict[tuple[str, int], np.ndarray] = {}
        self._original_error: list[float] = []
        self._coarse_error: dict[int, float] = {}
        self._known: dict[bytes, Quality] = {}
        # Taken now and not when images come: scenes that are loaded later must not count on it.
        pixels = [camera.width * camera.height for camera in self.cameras]
        images = 1 if self.photos is None else 2
        wanted = sum(camera.width * camera.height + _coarse_pixels(camera) for camera in self.cameras) * 12 * images
        self._work = LIBRARY_BYTES + WORK_BYTES * max(pixels)
        budget.take("comparing views", self._work)
        self._reserved = min(wanted, budget.free // SHARE)
        budget.take("reference images", self._reserved)
        self._left = self._reserved
        budget.reclaimers.append(self._give_back)

    def prepare(self, scene: DeviceScene, progress: Progress = SILENT) -> None:
        """Draw the references from `scene` (the original, loaded), and measure them against the photos."""
        self._original_error, self._coarse_error, self._known = [], {}, {}
        images = self.bench.images(scene, self.cameras)
        for i, drawn in enumerate(progress.track(images, "drawing the original", len(self.cameras))):
            # Clamped once, and contiguous by channel as renders are: comparing is then much faster.
            image = _planes(drawn)
            self._keep(("original", i), image)
            if self.photos is not None:
                photo = _planes(self.photos.load(self.indices[i]))
                self._original_error.append(mse(image, photo))
                self._keep(("photo", i), photo)

    def close(self) -> None:
        """Give the memory of the kept images back."""
        self._kept, self._away = {}, {}
        self._budget.give(self._reserved + self._work)
        self._reserved = self._work = self._left = 0
        if self._give_back in self._budget.reclaimers:
            self._budget.reclaimers.remove(self._give_back)

    def _give_back(self, short: int) -> None:
        """Give up room and then kept images until `short` bytes are free: to scratch files, or to be drawn and read again."""
        freed = min(self._left, short)
        self._left -= freed
        while freed < short and self._kept:
            key, image = self._kept.popitem()
            freed += image.nbytes
            self._put_away(key, image)
        self._reserved -= freed
        self._budget.give(freed)

    @property
    def kept(self) -> int:
        """Reference renders held in memory."""
        return sum(kind == "original" for kind, _ in self._kept)

    def compare(
        self,
        scene: DeviceScene,
        with_ssim: bool = False,
        progress: Progress = SILENT,
        lpips: Distance | None = None,
    ) -> Quality:
        """Quality of `scene` over the views. LPIPS takes far longer than drawing them.

        One that reports draws nothing twice: a scene that is the same to the bit has the same quality.
        """
        whole, elsewhere = self.reports and with_ssim and lpips is None, self.bench.ready_cluster is not None
        drawn = scene.fingerprint(elsewhere) if whole else None
        if drawn in self._known:
            return self._known[drawn]
        found: list[ViewQuality] = []
        images = self.bench.images(scene, self.cameras)
        for i, image in enumerate(progress.track(images, "comparing views", len(self.cameras))):
            error = self._original_error[i] if self.photos is not None else None
            references = self.original(i), self._photo(i)
            ssims = self._ssims if with_ssim else None
            found.append(compare_view(self.cameras[i].name, image, *references, error, ssims, lpips))
        quality = Quality(tuple(found), self.base_psnr)
        if whole and drawn is None:
            drawn = scene.fingerprint(elsewhere)
        if drawn is not None:
            self._known[drawn] = quality
        return quality

    def estimate(self, scene: DeviceScene) -> Quality:
        """`compare` at a fourth of the pixels, for a search that only has to know where to look next."""
        found = []
        few = [camera.every(ESTIMATE_STEP) for camera in self.cameras]
        for i, camera in enumerate(self.renderer.in_turn(scene, few)):
            image = self.renderer.render(scene, camera)
            found.append(compare_view(self.cameras[i].name, image, *self._coarse(i)))
        return Quality(tuple(found), self.base_psnr)

    def _coarse(self, i: int) -> tuple[np.ndarray, np.ndarray | None, float | None]:
        """What an estimate compares with: original and photo at its pixels, and the error between them."""
        every = (slice(None, None, ESTIMATE_STEP),) * 2
        original, photo = self._held(("coarse original", i)), self._held(("coarse photo", i))
        if original is None:
            original = _planes(self.original(i)[every])
            self._keep(("coarse original", i), original)
        if self.photos is None:
            return original, None, None
        if photo is None:
            found = self._photo(i)
            assert found is not None
            photo = _planes(found[every])
            self._keep(("coarse photo", i), photo)
        if i not in self._coarse_error:
            self._coarse_error[i] = mse(original, photo)
        return original, photo, self._coarse_error[i]

    def _ssims(self, pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> list[float | None]:
        height, width = pairs[0][0].shape[:2]
        work = min(ssim_bytes(width, height), self._work)
        self._budget.give(work)  # taken again by the arrays themselves
        try:
            return ssims(self.renderer.backend, pairs)
        finally:
            self._budget.take("comparing views", work)

    def images(self, scene: DeviceScene, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Render of `scene`, render of the original and photo of the view `indices[i]`: [H, W, 3] f32 in [0, 1]."""
        image = _planes(self.renderer.render(scene, self.cameras[i]))
        return image, _planes(self.original(i)), self._photo(i)

    def _keep(self, key: tuple[str, int], image: np.ndarray) -> None:
        if image.nbytes <= self._left:
            self._left -= image.nbytes
            self._kept[key] = image
        else:
            self._put_away(key, image)

    def _put_away(self, key: tuple[str, int], image: np.ndarray) -> None:
        """Keep an image in a scratch file, where this run has some."""
        storage = self.renderer.storage
        if storage.spills:
            height, width, _ = image.shape
            planes = storage.copy(image.transpose(2, 0, 1).reshape(3, -1))
            self._away[key] = planes.reshape(3, height, width).transpose(1, 2, 0)

    def _held(self, key: tuple[str, int]) -> np.ndarray | None:
        return self._kept.get(key, self._away.get(key))

    def original(self, i: int) -> np.ndarray:
        """Render of the original from the view `indices[i]`, [H, W, 3] f32."""
        held = self._held(("original", i))
        if held is None:
            with self.renderer.load(self.source) as scene:
                held = _planes(self.renderer.render(scene, self.cameras[i]))
            self._keep(("original", i), held)
        return held

    def _photo(self, i: int) -> np.ndarray | None:
        if self.photos is None:
            return None
        held = self._held(("photo", i))
        return self.photos.load(self.indices[i]) if held is None else held


def _coarse_pixels(camera: Camera) -> int:
    """Pixels that an estimate looks at."""
    few = camera.every(ESTIMATE_STEP)
    return few.width * few.height


def measurement_of(quality: Quality) -> Measurement:
    """The means that a search decides by, and the worst view's own figures."""
    worst = quality.worst
    alone = None if worst is None else Quality((worst,), quality.base_psnr)
    return Measurement(
        quality.drop,
        quality.fidelity,
        quality.modelled_drop,
        None if alone is None else Measurement(alone.drop, alone.fidelity, alone.modelled_drop),
    )


def _planes(image: np.ndarray) -> np.ndarray:
    """[H, W, 3] in [0, 1] whose memory is contiguous by channel."""
    planes = np.ascontiguousarray(image.transpose(2, 0, 1))
    np.clip(planes, 0.0, 1.0, out=planes)
    return planes.transpose(1, 2, 0)
