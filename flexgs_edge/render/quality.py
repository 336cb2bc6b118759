"""How good a picture is: PSNR, SSIM, drop, fidelity and the modelled drop (definitions: docs/method.md).

All figures are taken on images clamped to [0, 1] and kept in float, with one mean squared error over pixels and
channels. Identical images have no PSNR: it is `None` here and null in JSON, never infinity.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from flexgs_edge.constants import DEFAULT_BASE_PSNR
from flexgs_edge.errors import InputError

ROWS, BANDS = 128, 2
"""Image rows per step of the squared error, and steps side by side: bounds the float64 copies to a few MB whatever the
picture's height."""
Distance = Callable[[np.ndarray, np.ndarray], float | None]
"""A distance of two [H, W, 3] images; `None` where there is none."""
Similarities = Callable[[Sequence[tuple[np.ndarray, np.ndarray]]], Sequence[float | None]]
"""Similarities of several pairs of [H, W, 3] images of one size."""
MSE_FLOOR = 1e-12
"""Errors below this (120 dB, beyond float32 renders) count as this much where two PSNRs are subtracted."""


def mse(image: np.ndarray, reference: np.ndarray) -> float:
    """Mean squared error of two [H, W, 3] images clamped to [0, 1], summed in float64."""
    if image.shape != reference.shape:
        raise InputError(f"images of {_shape(reference)} and {_shape(image)} cannot be compared: sizes must be equal")

    def band(top: int) -> float:
        a = np.clip(image[top : top + ROWS], 0.0, 1.0).astype(np.float64)
        a -= np.clip(reference[top : top + ROWS], 0.0, 1.0)
        return float(np.square(a, out=a).sum())

    # NumPy lets other threads run: half the time. Bands are added in their order, so the sum does not depend on it.
    with ThreadPoolExecutor(BANDS) as pool:
        return sum(pool.map(band, range(0, image.shape[0], ROWS))) / max(image.size, 1)


def psnr(error: float) -> float | None:
    """PSNR in dB of a mean squared error on a data range of 1; `None` for identical images.

    >>> psnr(1e-3), psnr(0.0)
    (30.0, None)
    """
    return None if error == 0.0 else -10.0 * math.log10(error)


def mse_of_psnr(decibel: float) -> float:
    """Mean squared error behind a PSNR in dB.

    >>> mse_of_psnr(30.0)
    0.001
    """
    return 10.0 ** (-decibel / 10.0)


def mean_psnr(values: Sequence[float | None]) -> float | None:
    """Mean of per-view PSNRs in dB over the views that differ; `None` when all are identical (or there are none).

    Identical views would lift the mean to infinity; leaving them out can only make the figure worse.
    """
    known = [value for value in values if value is not None]
    return math.fsum(known) / len(known) if known else None


def drop(original_error: float, error: float) -> float:
    """Drop in dB: PSNR(photo, original render) - PSNR(photo, this render), from the two mean squared errors.

    >>> round(drop(0.001, 0.002), 2), drop(0.001, 0.001)
    (3.01, 0.0)
    """
    return 10.0 * math.log10(max(error, MSE_FLOOR) / max(original_error, MSE_FLOOR))


def modelled_drop(error: float, base_psnr: float = DEFAULT_BASE_PSNR) -> float:
    """Drop in dB that an error against the original's renders costs if it is independent of the original's own error.

    Parameters
    ----------
    error : float
        Mean squared error against the original's renders.
    base_psnr : float
        PSNR of the original against its photos, dB.

    >>> round(modelled_drop(mse_of_psnr(41.87), 36.0), 2)
    1.0
    """
    return 10.0 * math.log10(1.0 + error / mse_of_psnr(base_psnr))


def error_for_drop(decibel: float, base_psnr: float = DEFAULT_BASE_PSNR) -> float:
    """Mean squared error against the original's renders that makes a modelled drop of `decibel`."""
    return mse_of_psnr(base_psnr) * (10.0 ** (decibel / 10.0) - 1.0)


def fidelity_for_drop(decibel: float, base_psnr: float = DEFAULT_BASE_PSNR) -> float | None:
    """Fidelity in dB at which the modelled drop is `decibel`; `None` when only identical renders would do.

    >>> round(fidelity_for_drop(1.0), 1)
    39.9
    """
    error = error_for_drop(decibel, base_psnr)
    return psnr(error) if error > 0.0 else None


@dataclass(frozen=True)
class ViewQuality:
    """Figures of one view; PSNRs in dB, `None` where images are identical or there is nothing to compare with.

    Parameters
    ----------
    name : str
        The view's name.
    error : float
        Mean squared error against the original's render.
    photo_error, original_error : float or None
        Mean squared error of this render and of the original's render against the photo; `None` without a photo.
    ssim_original, ssim_photo, original_ssim : float or None
        SSIM against the original's render, against the photo, and of the original against the photo.
    lpips_original, lpips_photo, original_lpips : float or None
        LPIPS of the same three pairs; `None` unless it was asked for.
    """

    name: str
    error: float
    photo_error: float | None = None
    original_error: float | None = None
    ssim_original: float | None = None
    ssim_photo: float | None = None
    original_ssim: float | None = None
    lpips_original: float | None = None
    lpips_photo: float | None = None
    original_lpips: float | None = None

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


@dataclass(frozen=True)
class Quality:
    """Figures of a scene over its evaluation views: means of the per-view figures, and the worst view.

    Parameters
    ----------
    views : tuple of ViewQuality
        One record a view, in order of name.
    base_psnr : float
        PSNR of the original that the modelled drop starts from, dB.
    """

    views: tuple[ViewQuality, ...]
    base_psnr: float = DEFAULT_BASE_PSNR

    def _mean(self, name: str) -> float | None:
        return mean_psnr([getattr(view, name) for view in self.views])

    @property
    def error(self) -> float:
        """Mean squared error against the original's renders, mean over the views."""
        return math.fsum(view.error for view in self.views) / max(len(self.views), 1)

    @property
    def fidelity(self) -> float | None:
        """Mean PSNR against the original's renders, dB; `None` when every view is identical."""
        return self._mean("fidelity")

    @property
    def psnr(self) -> float | None:
        """Mean PSNR against the photos, dB."""
        return self._mean("psnr")

    @property
    def original_psnr(self) -> float | None:
        """Mean PSNR of the original against the photos, dB."""
        return self._mean("original_psnr")

    @property
    def drop(self) -> float | None:
        """Mean drop against the photos, dB; `None` without photos."""
        return self._mean("drop")

    @property
    def modelled_drop(self) -> float:
        """Drop in dB that the mean squared error against the original's renders would cost."""
        return modelled_drop(self.error, self.base_psnr)

    @property
    def identical(self) -> int:
        """Views whose render is the original's, pixel for pixel."""
        return sum(view.error == 0.0 for view in self.views)

    @property
    def ssim_original(self) -> float | None:
        """Mean SSIM against the original's renders."""
        return self._mean("ssim_original")

    @property
    def ssim_photo(self) -> float | None:
        """Mean SSIM against the photos."""
        return self._mean("ssim_photo")

    @property
    def original_ssim(self) -> float | None:
        """Mean SSIM of the original against the photos."""
        return self._mean("original_ssim")

    @property
    def by_loss(self) -> list[int]:
        """Indices of the views, the worst first: by drop where all have photos, else by their error."""
        drops = [view.drop for view in self.views]
        losses = [view.error if None in drops else drop or 0.0 for view, drop in zip(self.views, drops)]
        return sorted(range(len(losses)), key=lambda index: -losses[index])

    @property
    def lpips_original(self) -> float | None:
        """Mean LPIPS against the original's renders."""
        return self._mean("lpips_original")

    @property
    def lpips_photo(self) -> float | None:
        """Mean LPIPS against the photos."""
        return self._mean("lpips_photo")

    @property
    def original_lpips(self) -> float | None:
        """Mean LPIPS of the original against the photos."""
        return self._mean("original_lpips")

    @property
    def worst(self) -> ViewQuality | None:
        """The view with the largest drop (with photos) or the lowest fidelity (without); `None` without views."""
        return self.views[self.by_loss[0]] if self.views else None


def compare_view(
    name: str,
    image: np.ndarray,
    original: np.ndarray,
    photo: np.ndarray | None = None,
    original_error: float | None = None,
    ssims: Similarities | None = None,
    lpips: Distance | None = None,
) -> ViewQuality:
    """Figures of one render.

    Parameters
    ----------
    name : str
        The view's name.
    image, original : np.ndarray
        Renders of the scene in question and of the original, [H, W, 3] f32, not clamped.
    photo : np.ndarray, optional
        The photo, [H, W, 3] f32 in [0, 1].
    original_error : float, optional
        Mean squared error of `original` against `photo`, if it is known already.
    ssims : callable, optional
        Also measure this similarity of all pairs of images.
    lpips : callable, optional
        Also measure this distance of two images (about 3 s a megapixel for LPIPS).
    """
    if photo is not None and original_error is None:
        original_error = mse(original, photo)
    similar: list[float | None] = [None] * 3
    if ssims:
        pairs = [(image, original), *([(image, photo), (original, photo)] if photo is not None else ())]
        similar[: len(pairs)] = ssims(pairs)
    return ViewQuality(
        name=name,
        error=mse(image, original),
        photo_error=None if photo is None else mse(image, photo),
        original_error=None if photo is None else original_error,
        ssim_original=similar[0],
        ssim_photo=similar[1],
        original_ssim=similar[2],
        lpips_original=lpips(image, original) if lpips else None,
        lpips_photo=lpips(image, photo) if lpips and photo is not None else None,
        original_lpips=lpips(original, photo) if lpips and photo is not None else None,
    )


def _shape(image: np.ndarray) -> str:
    return "x".join(str(side) for side in image.shape[1::-1])
