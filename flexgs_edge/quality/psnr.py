"""Mean squared error (MSE) of images, and the decibels from it: PSNR, drop, fidelity and modelled drop.

Images are clamped to [0, 1] and compared as floats, over all pixels and channels. Identical images have no PSNR: it is
`None` here and null in JSON, never infinity.
"""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from math import isqrt
from statistics import median

import numpy as np

from flexgs_edge.constants import DEFAULT_BASE_PSNR
from flexgs_edge.errors import InputError

ROWS, BANDS = 128, 2
"""Image rows of one step of the squared error, and steps that run in parallel. They bound the f64 copies to a few MB
for pictures of any height."""
_BANDS = ThreadPoolExecutor(BANDS, "bands")
MSE_FLOOR = 1e-12
"""Smallest MSE in a difference of two PSNRs; smaller ones (120 dB) are beyond the precision of float32 renders."""
BLIND_DROP = 1.0  # A photo that would not show a larger drop than this does not judge its view, dB: see `far_bases`
DARK, BRIGHT = 2 / 255, 253 / 255  # Values outside these may be clipped, and tell no gain
FIT_PIXELS = 1 << 16
"""Every n-th pixel in both directions is fitted, so that at least this many are, or all of a smaller picture."""
LEAST_GAIN = 0.5
"""A fit counts if it lowers the error by this much, dB. Without a smaller one, a drop of 1 dB reads as .9 dB or more."""

MOVED = 0.0015
"""By this angle pictures are moved to tell how far photos may be from them, radians: three quarters of a pixel of an automatic
view."""
LONE_BASES = 32.5, 34.5, 36.0
"""Least base without photos, least base of what is fine-tuned, and largest base, dB. Moved pictures of real cameras begin at
32.4. What is fine-tuned to automatic views loses more from elsewhere than it does there."""


def mse(image: np.ndarray, reference: np.ndarray) -> float:
    """Mean squared error of two [H, W, 3] images clamped to [0, 1], summed in float64."""
    return mse_later(image, reference)()


def mse_later(image: np.ndarray, reference: np.ndarray) -> Callable[[], float]:
    """As `mse`, in threads beside what the caller does next. The returned function waits for the result.

    Until then, neither image may change.
    """
    if image.shape != reference.shape:
        raise InputError(f"images of {_shape(reference)} and {_shape(image)} cannot be compared: sizes must be equal")

    def band(top: int) -> float:
        a = np.clip(image[top : top + ROWS], 0.0, 1.0).astype(np.float64)
        a -= np.clip(reference[top : top + ROWS], 0.0, 1.0)
        return float(np.square(a, out=a).sum())

    # NumPy releases the interpreter's lock. Bands are added in their order, so the sum does not depend on the threads.
    errors = [_BANDS.submit(band, top) for top in range(0, image.shape[0], ROWS)]
    return lambda: sum(error.result() for error in errors) / max(image.size, 1)


def psnr(error: float) -> float | None:
    """PSNR in dB, for a data range of 1, from a mean squared error; `None` for identical images.

    >>> psnr(1e-3), psnr(0.0)
    (30.0, None)
    """
    return None if error == 0.0 else -10.0 * math.log10(error)


def mse_of_psnr(decibel: float) -> float:
    """Mean squared error of images with this PSNR in dB.

    >>> mse_of_psnr(30.0)
    0.001
    """
    return float(10.0 ** (-decibel / 10.0))


def mean_psnr(values: Sequence[float | None]) -> float | None:
    """Mean PSNR in dB over the views that are not identical; `None` if all are identical, or there is no view.

    An identical view would lift the mean to infinity. Leaving it out can only make the figure worse.
    """
    known = [value for value in values if value is not None]
    return math.fsum(known) / len(known) if known else None


def drop(original_error: float, error: float) -> float:
    """Drop in dB, PSNR(photo, original render) - PSNR(photo, this render), from both mean squared errors.

    >>> round(drop(0.001, 0.002), 2), drop(0.001, 0.001)
    (3.01, 0.0)
    """
    return 10.0 * math.log10(max(error, MSE_FLOOR) / max(original_error, MSE_FLOOR))


def modelled_drop(error: float, base_psnr: float = DEFAULT_BASE_PSNR) -> float:
    """Drop in dB against photos that are not there, from the error against the original's renders.

    The model assumes that this error is independent of the original's own error.

    `error`: mean squared error against the original's renders. `base_psnr`: assumed PSNR of the original against its
    photos, dB.

    >>> round(modelled_drop(mse_of_psnr(41.87), 36.0), 2)
    1.0
    """
    return 10.0 * math.log10(1.0 + error / mse_of_psnr(base_psnr))


def moved_error(image: np.ndarray, focal: float) -> float:
    """Mean squared error of an [H, W, 3] image against itself, moved right or down by the angle `MOVED`.

    `focal`: Focal length, pixels.
    """
    step = max(1, round(MOVED * focal))
    height, width, _ = image.shape
    if min(height, width) <= step:
        return 0.0
    error = (mse(image[:, step:], image[:, :-step]) + mse(image[step:], image[:-step])) / 2
    return error * min(MOVED * focal / step, 1.0) ** 2


def lone_base(errors: Sequence[float], coverages: Sequence[float], finetuned: bool) -> float:
    """Assumed PSNR of an original against photos that are not there, dB.

    Pictures with much detail are farther from their photos than those with little, about as far as from themselves when they
    are moved by three quarters of a pixel: docs/results/tuning.md#default_base_psnr

    `errors`: `moved_error` of the original's render in each view. `coverages`: share of each view that the original
    covers, which alone counts. `finetuned`: what is compared may have been fine-tuned to the views.

    >>> lone_base([3.2e-4, 1.6e-4], [1.0, 0.5], True), lone_base([1.0], [1.0], True), lone_base([1.0], [1.0], False)
    (34.9, 34.5, 32.5)
    """
    error = math.fsum(errors) / (math.fsum(coverages) or 1.0)
    low, finetuned_low, high = LONE_BASES
    found = -10.0 * math.log10(max(error, MSE_FLOOR))
    return round(min(max(found, finetuned_low if finetuned else low), high), 1)


def contrast(image: np.ndarray) -> float:
    """Mean squared error of a picture of one colour, the mean, against an [H, W, 3] image."""
    return float(image.var(axis=(0, 1), dtype=np.float64).mean())


def far_bases(
    original_errors: Sequence[float], contrasts: Sequence[float], base_psnr: float = DEFAULT_BASE_PSNR
) -> list[float | None]:
    """For views that their photos cannot judge, the base of the modelled drop by which they count; `None` for the others.

    A photo cannot judge if a picture of one colour would lose less than `BLIND_DROP` against it, or if an error that costs
    this much there is larger than that of the original in the usual view.

    `original_errors`: mean squared error of the original against the photo of each view. `contrasts`: `contrast` of
    each photo. `base_psnr`: largest base, dB, and the base if most photos do not show what their cameras saw.

    >>> [base and round(base, 1) for base in far_bases([1e-3, 1e-3, 2e-2, 1e-3], [3e-2, 3e-2, 3e-2, 1e-3])]
    [None, None, 30.0, 30.0]
    """
    times = float(10.0 ** (BLIND_DROP / 10.0))
    seen = [error * times < most for error, most in zip(original_errors, contrasts, strict=True)]
    least = mse_of_psnr(base_psnr)
    known = [error for error, clear in zip(original_errors, seen, strict=True) if clear]
    usual = max(median(known), least) if 2 * len(known) > len(seen) else least
    base = min(-10.0 * math.log10(usual), base_psnr)
    return [
        None if clear and error * (times - 1.0) <= usual else base
        for error, clear in zip(original_errors, seen, strict=True)
    ]


def _shape(image: np.ndarray) -> str:
    return "x".join(str(side) for side in image.shape[1::-1])


def exposure_gains(image: np.ndarray, photo: np.ndarray) -> np.ndarray | None:
    """Gains that bring a photo to the exposure of a render, in closed form; `None` if they would hardly change its error.

    Of each channel, least squares in linear light over the pixels where neither is clipped.

    `image`: render of the original, [H, W, 3] f32, sRGB in [0, 1]. `photo`: the photo, [H, W, 3] f32, sRGB in [0, 1].
    Returns [3] f64, above 0, for red, green and blue.
    """
    height, width, _ = image.shape
    step = max(isqrt(height * width // FIT_PIXELS), 1)
    image, photo = image[::step, ::step], photo[::step, ::step]
    clear = (np.minimum(image, photo) > DARK) & (np.maximum(image, photo) < BRIGHT)
    target, light = _linear(image) * clear, _linear(photo) * clear
    squares = np.square(light).sum(axis=(0, 1))
    if not squares.all():
        return None
    gains: np.ndarray = (target * light).sum(axis=(0, 1)) / squares
    fitted = mse(image, with_gains(photo, gains, image))
    return gains if drop(fitted, mse(image, photo)) >= LEAST_GAIN else None


def with_gains(photo: np.ndarray, gains: np.ndarray | None, image: np.ndarray) -> np.ndarray:
    """The photo times its gains, [H, W, 3] f32, sRGB in [0, 1], channel by channel in memory; `None` leaves it as it is.

    A clipped value tells only that there was at least so much light. Where `image`, the original, is brighter, it stands.
    """
    if gains is None:
        return photo
    planes = []
    for c, gain in enumerate(gains):
        fitted = _encoded(_linear(photo[..., c]) * gain)
        planes.append(np.where(photo[..., c] >= BRIGHT, np.maximum(fitted, image[..., c]), fitted))
    return np.stack(planes).transpose(1, 2, 0)


def _linear(values: np.ndarray) -> np.ndarray:
    """Light of sRGB values (IEC 61966-2-1), f64."""
    values = values.astype(np.float64)
    return np.where(values > 0.04045, ((values + 0.055) / 1.055) ** 2.4, values / 12.92)


def _encoded(light: np.ndarray) -> np.ndarray:
    """SRGB values of light, f32, clipped at 1."""
    light = np.minimum(light, 1.0)
    return np.where(light > 0.0031308, 1.055 * light ** (1 / 2.4) - 0.055, 12.92 * light).astype(np.float32)
