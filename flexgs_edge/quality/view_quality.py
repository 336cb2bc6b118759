"""Quality of one view, and its means over all evaluated views.

Plain figures count every pixel alike. Covered figures divide the same squared errors by the pixels that the original
covers: each pixel counts by the original's alpha there. Empty background then cannot dilute an error, and errors outside
the original's silhouette still count. Both are equal where the original fills the picture.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from flexgs_edge.constants import DEFAULT_BASE_PSNR
from flexgs_edge.quality.psnr import drop, mean_psnr, modelled_drop, mse, mse_later, psnr
from flexgs_edge.quality.similarity import modelled_ssim_drop

Distance = Callable[[np.ndarray, np.ndarray], float | None]
"""Distance of two [H, W, 3] images; `None` if it is not defined for them."""
LEAST_COVERAGE = 0.1
"""The worst view by covered figures has at least this share of the mean coverage. Views that see a few faint pixels have
large errors relative to them, and nobody would see these."""
ALIKE = 48.0  # Fidelity in dB from which on more of it shows nothing: an error of one level of 255
Figures = Callable[[Sequence[tuple[np.ndarray, np.ndarray]]], Sequence[float | None]]
"""Figures of pairs of [H, W, 3] images, all of one size."""


@dataclass(frozen=True)
class ViewQuality:
    """Quality of one view. PSNRs are in dB, and `None` if images are identical or one of them is missing.

    `photo_error`, `original_error`: mean squared error of this render, and of the original's render, against the photo; `None`
    without a photo. `ssim_original`, `ssim_photo`, `original_ssim`: SSIM against the original's render, against the photo, and
    of the original against the photo. `lpips_original`, `lpips_photo`, `original_lpips`: LPIPS of the same three pairs; `None`
    unless it was asked for. `flip_original`, `flip_photo`, `original_flip`: FLIP of the same three pairs, mean over the pixels.
    """

    name: str  # name of the view
    error: float  # mean squared error against the original's render
    photo_error: float | None = None
    original_error: float | None = None
    ssim_original: float | None = None
    ssim_photo: float | None = None
    original_ssim: float | None = None
    lpips_original: float | None = None
    lpips_photo: float | None = None
    original_lpips: float | None = None
    flip_original: float | None = None
    flip_photo: float | None = None
    original_flip: float | None = None
    # Share of the picture that the original covers, 0 to 1: the mean over the pixels of its accumulated alpha.
    coverage: float = 1.0
    # Base of the modelled drop by which the view counts, dB, if the original is far from its photo (`far_bases`).
    far_base: float | None = None
    # Stops of red, green and blue by which the photo was brightened to the exposure of the original.
    exposure: tuple[float, ...] | None = None

    @property
    def covered_error(self) -> float | None:
        """Squared error against the original's render, per covered pixel and channel; `None` if the original covers nothing."""
        return self.error / self.coverage if self.coverage else None

    @property
    def covered_fidelity(self) -> float | None:
        """PSNR from `covered_error`, dB; also `None` if the original covers nothing."""
        return psnr(self.covered_error or 0.0)

    @property
    def fidelity(self) -> float | None:
        """PSNR against the original's render, dB."""
        return psnr(self.error)

    @property
    def psnr(self) -> float | None:
        """PSNR against the photo, dB."""
        return None if self.photo_error is None else psnr(self.photo_error)

    @property
    def original_psnr(self) -> float | None:
        """PSNR of the original against the photo, dB."""
        return None if self.original_error is None else psnr(self.original_error)

    @property
    def drop(self) -> float | None:
        """Drop against the photo, dB."""
        if self.photo_error is None or self.original_error is None:
            return None
        return drop(self.original_error, self.photo_error)

    @property
    def loss(self) -> float | None:
        """The drop that counts, dB: against the photo, or modelled if the original is far from it; `None` without a photo."""
        return self.drop if self.far_base is None else modelled_drop(self.error, self.far_base)

    @property
    def ssim_loss(self) -> float | None:
        """SSIM lost against the photo, at least 0: a view that gains allows no more loss elsewhere; `None` without a photo."""
        if self.original_ssim is None or self.ssim_photo is None:
            return None
        return max(self.original_ssim - self.ssim_photo, 0.0)


class _MeanOf:
    """The mean over the views of their figure of this name; `None` where no view has it."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, quality: "Quality", owner: type) -> float | None:
        return mean_psnr([getattr(view, self._name) for view in quality.views])


@dataclass(frozen=True)
class Quality:
    """Quality of a scene over its evaluation views: means over the views, and the worst view."""

    views: tuple[ViewQuality, ...]  # one record for each view, sorted by name
    base_psnr: float = DEFAULT_BASE_PSNR  # assumed PSNR of the original against photos, for the modelled drop, dB
    covered_decides: bool = False  # The covered figures decide: there are no photos. Default: the plain figures decide.
    made: "Quality | None" = None  # quality at made poses, where no given camera stood; `None` if not measured

    fidelity = _MeanOf()  # against the original's renders, dB; `None` if every view is identical
    psnr, original_psnr, drop = _MeanOf(), _MeanOf(), _MeanOf()  # against the photos, dB; `None` without photos
    ssim_original, ssim_photo, original_ssim = _MeanOf(), _MeanOf(), _MeanOf()
    lpips_original, lpips_photo, original_lpips = _MeanOf(), _MeanOf(), _MeanOf()
    flip_original, flip_photo, original_flip = _MeanOf(), _MeanOf(), _MeanOf()

    @property
    def error(self) -> float:
        """Mean squared error against the original's renders, mean over the views."""
        return math.fsum(view.error for view in self.views) / max(len(self.views), 1)

    @property
    def modelled_drop(self) -> float:
        """Modelled drop in dB, from the mean squared error against the original's renders."""
        return modelled_drop(self.error, self.base_psnr)

    @property
    def coverage(self) -> float:
        """Mean coverage of the views."""
        return math.fsum(view.coverage for view in self.views) / max(len(self.views), 1)

    @property
    def covered_error(self) -> float:
        """Squared error of all views over their covered pixels: `error` divided by `coverage`.

        Each view counts by its coverage, so that a view of a few faint pixels cannot decide. If no view covers anything,
        it is the plain error.
        """
        return self.error / (self.coverage or 1.0)

    @property
    def covered_fidelity(self) -> float | None:
        """Mean of the views' covered fidelity, weighted by their coverage, dB; `None` if every covered view is identical."""
        found = [(view.coverage, view.covered_fidelity) for view in self.views]
        known = [(weight, value) for weight, value in found if value is not None]
        total = math.fsum(weight for weight, _ in known)
        return math.fsum(weight * value for weight, value in known) / total if known else None

    @property
    def covered_modelled_drop(self) -> float:
        """Modelled drop in dB, from `covered_error`."""
        return modelled_drop(self.covered_error, self.base_psnr)

    @property
    def deciding_fidelity(self) -> float | None:
        """The mean fidelity that decides: `covered_fidelity` or `fidelity`."""
        return self.covered_fidelity if self.covered_decides else self.fidelity

    @property
    def usual_drop(self) -> float | None:
        """Mean over the views of the drop that decides, where a view that gains counts as 0, dB; `None` without views."""
        losses = [max(loss, 0.0) for loss in self.losses if loss is not None]
        return math.fsum(losses) / len(losses) if losses else None

    @property
    def losses(self) -> list[float | None]:
        """The drop of each view that decides: against the photo, else modelled; `None` for views with hardly any coverage."""
        drops = [view.loss for view in self.views]
        if None not in drops:
            return drops
        least = LEAST_COVERAGE * self.coverage if self.covered_decides else 0.0
        errors = [view.covered_error if self.covered_decides else view.error for view in self.views]
        return [
            modelled_drop(error or 0.0, self.base_psnr) if view.coverage >= least else None
            for view, error in zip(self.views, errors, strict=True)
        ]

    @property
    def ssim_drop(self) -> float | None:
        """SSIM lost, mean over the views: `ViewQuality.ssim_loss`; modelled without photos; `None` if not measured."""
        lost = [view.ssim_loss for view in self.views]
        known = [loss for loss in lost if loss is not None]
        if known:
            return math.fsum(known) / len(known)
        if self.ssim_original is None:
            return None
        shared = 1.0 - self.ssim_original
        return modelled_ssim_drop(shared / (self.coverage or 1.0) if self.covered_decides else shared)

    @property
    def made_gap(self) -> float | None:
        """How much less fidelity made poses have, dB, of at most `ALIKE`; `None` if they were not measured or are identical."""
        own, made = self.deciding_fidelity, None if self.made is None else self.made.deciding_fidelity
        return None if own is None or made is None else min(own, ALIKE) - made

    @property
    def identical(self) -> int:
        """Number of views with a render identical to the original's."""
        return sum(view.error == 0.0 for view in self.views)

    @property
    def by_loss(self) -> list[int]:
        """Indices of the views, the worst first: by drop if all have photos, else by the error that decides.

        If covered figures decide, views with hardly any coverage come last (`LEAST_COVERAGE`).
        """
        drops = [view.loss for view in self.views]
        if None not in drops:
            losses = [drop or 0.0 for drop in drops]
        elif not self.covered_decides:
            losses = [view.error for view in self.views]
        else:
            least = LEAST_COVERAGE * self.coverage
            losses = [(view.covered_error or 0.0) if view.coverage >= least else -1.0 for view in self.views]
        return sorted(range(len(losses)), key=lambda index: -losses[index])

    @property
    def worst_flip(self) -> ViewQuality | None:
        """The view with the largest FLIP against the original's render; `None` if it was not measured."""
        known = [view for view in self.views if view.flip_original is not None]
        return max(known, key=lambda view: view.flip_original or 0.0) if known else None

    @property
    def worst(self) -> ViewQuality | None:
        """The view with the largest loss (with photos) or the lowest fidelity (without); `None` without views."""
        return self.views[self.by_loss[0]] if self.views else None


def compare_view(
    name: str,  # name of the view
    image: np.ndarray,
    original: np.ndarray,
    photo: np.ndarray | None = None,  # the photo, [H, W, 3] f32 in [0, 1]
    original_error: float | None = None,  # mean squared error of `original` against `photo`, if it is known already
    original_ssim: float | None = None,  # SSIM of the same two, if it is known already
    ssims: Figures | None = None,  # measures the similarity of all pairs of images; by default SSIM is left out
    lpips: Distance | None = None,
    coverage: float = 1.0,  # Share of the picture that the original covers. Default: all of it.
    flips: Figures | None = None,  # measures FLIP of all pairs of images; left out by default
) -> ViewQuality:
    """Measure the quality of one render.

    `image`, `original`: renders of the compressed scene and of the original, [H, W, 3] f32, not clamped. `lpips`:
    measures a distance of all pairs of images; left out by default. LPIPS takes seconds for each pair.
    """
    if photo is not None and original_error is None:
        original_error = mse(original, photo)
    error = mse_later(image, original)
    photo_error = None if photo is None else mse_later(image, photo)
    similar = _three(ssims, image, original, photo, original_ssim)
    view = ViewQuality(
        name=name,
        error=error(),
        photo_error=photo_error() if photo_error else None,
        original_error=None if photo is None else original_error,
        ssim_original=similar[0],
        ssim_photo=similar[1],
        original_ssim=similar[2],
        lpips_original=lpips(image, original) if lpips else None,
        lpips_photo=lpips(image, photo) if lpips and photo is not None else None,
        original_lpips=lpips(original, photo) if lpips and photo is not None else None,
        coverage=coverage,
    )
    return with_flip(view, image, original, photo, flips) if flips else view


def with_flip(
    view: ViewQuality, image: np.ndarray, original: np.ndarray, photo: np.ndarray | None, flips: Figures
) -> ViewQuality:
    """The quality of a view with its FLIP, from the images that `compare_view` takes."""
    against_original, against_photo, originals = _three(flips, image, original, photo)
    return replace(view, flip_original=against_original, flip_photo=against_photo, original_flip=originals)


def _three(
    figures: Figures | None,
    image: np.ndarray,
    original: np.ndarray,
    photo: np.ndarray | None,
    originals: float | None = None,
) -> list[float | None]:
    """Figures of the image against the original and the photo, and of the original against the photo: `originals` if known."""
    found: list[float | None] = [None] * 3
    if figures:
        found[2] = originals
        pairs = [(image, original)]
        if photo is not None:
            pairs += [(image, photo), (original, photo)][: 2 if originals is None else 1]
        found[: len(pairs)] = figures(pairs)
    return found
