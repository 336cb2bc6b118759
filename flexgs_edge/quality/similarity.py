"""FLIP and SSIM of images, computed on a backend.

FLIP equals NVIDIA's own program, `flip-evaluator`, to 1e-4, and SSIM equals scikit-image's with a Gaussian window.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from flexgs_edge.constants import (
    FLIP_DEGREE,
    FLIP_FEATURE,
    FLIP_FEATURE_REACH,
    FLIP_REACH,
    FLIP_WIDEST,
    LANES,
    SSIM_WINDOW,
)
from flexgs_edge.errors import InputError
from flexgs_edge.kernels.backend import Backend, window

FILTERS = 7
"""Filters of a direction: light, red against green, yellow against blue (two parts), and light for features (three)."""
SEEN = 5  # Values of a pixel that are compared: colour (three), edges and points
BAND = 1 << 16
"""Most elements of a band of rows, so that all planes together take 8 MB, and one fits a core's cache. Values do not
depend on bands. docs/results/tuning.md#flip"""
_LIGHT, _RED_GREEN, _BLUES = 0.0047, 0.0053, ((34.1, FLIP_WIDEST), (13.5, 0.025))
"""Widths of the Gaussians that the paper fits to the eye's sensitivity to contrast. Yellow against blue has the sum of two, of
which the first number is the height."""
Pairs = Sequence[tuple[np.ndarray, np.ndarray]]
LOST_SHARE = 0.7  # SSIM lost against photos, as a share of what is lost against the original's renders


def taps() -> np.ndarray:
    """[FILTERS, 2 FLIP_REACH + 1] f32, the weights of the filters along one direction.

    Light, red against green, and two parts whose sum filters yellow against blue: Gaussians. Then a Gaussian, its first
    and its second derivative, of which the positive and the negative weights each add up to 1.
    """
    away = np.arange(-FLIP_REACH, FLIP_REACH + 1)

    def gaussian(width: float) -> np.ndarray:
        return np.exp(-(math.pi**2) * np.square(away / FLIP_DEGREE) / width)

    light, red_green = gaussian(_LIGHT), gaussian(_RED_GREEN)
    blues = [gaussian(width) for _, width in _BLUES]
    # In two dimensions both have the heights of one: their shares of the sum follow from that.
    weights = [
        height * math.sqrt(math.pi / width) * taps.sum() ** 2
        for (height, width), taps in zip(_BLUES, blues, strict=True)
    ]
    blues = [math.sqrt(weight / sum(weights)) * taps / taps.sum() for weight, taps in zip(weights, blues, strict=True)]
    deviation = 0.5 * FLIP_FEATURE * FLIP_DEGREE
    smooth = np.where(np.abs(away) <= FLIP_FEATURE_REACH, np.exp(-0.5 * np.square(away / deviation)), 0.0)
    slope, bend = -away * smooth, (np.square(away / deviation) - 1.0) * smooth
    for filter in (slope, bend):
        filter[filter > 0] /= filter[filter > 0].sum()
        filter[filter < 0] /= -filter[filter < 0].sum()
    found = [light / light.sum(), red_green / red_green.sum(), *blues, smooth / smooth.sum(), slope, bend]
    return np.stack(found).astype(np.float32)


def _layout(width: int, height: int) -> tuple[int, int]:
    """Elements of a row, and rows of a band: bands are about equal."""
    stride = -(-(width + 2 * FLIP_REACH) // LANES) * LANES
    bands = -(-height // max(BAND // stride, 1))
    return stride, -(-height // bands)


def flip_bytes(width: int, height: int, images: int = 3) -> int:
    """Bytes that `flip_maps` takes on the backend to compare `images` images of this size."""
    stride, rows = _layout(width, height)
    count = rows * stride
    read = (rows + 2 * FLIP_REACH) * stride
    return 4 * (3 * read + FILTERS * (count + LANES) + (SEEN * images + 1) * count + FILTERS * (2 * FLIP_REACH + 1))


def flip_maps(backend: Backend, pairs: Pairs) -> list[np.ndarray]:
    """FLIP at every pixel of pairs of images of one size (LDR-FLIP, Andersson et al. 2020).

    FLIP says how different two images look to somebody who flips between them: 0 for equal ones, at most 1. It assumes
    `FLIP_DEGREE` pixels per degree.

    `pairs`: [H, W, 3] f32, sRGB; clamped to [0, 1] here. An image that is in several pairs is filtered once. Returns
    [H, W] f32 for each pair.
    """
    images = list({id(image): image for pair in pairs for image in pair}.values())
    if any(image.shape != images[0].shape for image in images):
        raise InputError("FLIP: images of different sizes cannot be compared")
    if not images:
        return []
    height, width = images[0].shape[:2]
    stride, rows = _layout(width, height)
    most, read = rows * stride, (rows + 2 * FLIP_REACH) * stride
    shapes: list[tuple[int, ...]] = [(FILTERS, 2 * FLIP_REACH + 1), (3, read), (FILTERS, most + LANES)]
    shapes += [(SEEN, most)] * len(images) + [(most,)]
    found = [np.empty((height, width), np.float32) for _ in pairs]
    arrays: list[Any] = []
    try:
        for shape in shapes:
            arrays.append(backend.array(shape, np.float32))
        weights, planes, columns, *seen, flip = arrays
        backend.write(weights, taps())
        backend.fill(columns, 0)  # filters read beyond the last row, but what they find there is not used
        numbers = {id(image): seen[i] for i, image in enumerate(images)}
        for top in range(0, height, rows):
            for image in images:
                backend.write(planes, _padded(image, top, rows, stride))
                backend.launch("flip_colours", (read,), read, read, planes)
                backend.launch("flip_columns", (most,), most, stride, read, most + LANES, weights, planes, columns)
                backend.launch("flip_rows", (most,), most, most + LANES, weights, columns, numbers[id(image)])
            left = min(rows, height - top)
            for (one, two), to in zip(pairs, found, strict=True):
                backend.launch("flip_pair", (most,), most, numbers[id(one)], numbers[id(two)], flip)
                to[top : top + left] = backend.read(flip).reshape(rows, stride)[:left, :width]
        return found
    finally:
        for array in arrays:
            array.release()


def flips(backend: Backend, pairs: Pairs) -> list[float | None]:
    """FLIP of pairs of images of one size, mean over the pixels; see `flip_maps`."""
    # Twice the reach: what filters see beyond a cut are repeated borders.
    return [
        float(found.sum(dtype=np.float64)) / max(pair[0][..., 0].size, 1)
        for pair, found in zip(pairs, flip_maps(backend, _differing(pairs, 2 * FLIP_REACH)), strict=True)
    ]


def _differing(pairs: Pairs, reach: int) -> Pairs:
    """The pairs cut down to a part: beyond it, and as far as `reach` pixels inside of it, each has two equal images.

    An object before a background leaves most of a picture out.
    """
    if len({image.shape for pair in pairs for image in pair}) != 1 or not pairs[0][0].size:
        return pairs
    apart = np.logical_or.reduce([(one != two).any(axis=2) for one, two in pairs])
    ends = (np.append(np.flatnonzero(apart.any(axis=axis)), [] if apart.any() else [0])[[0, -1]] for axis in (1, 0))
    rows, columns = (slice(max(int(first) - reach, 0), int(last) + reach + 1) for first, last in ends)
    parts = {id(image): image[rows, columns] for pair in pairs for image in pair}
    return [(parts[id(one)], parts[id(two)]) for one, two in pairs]


def _padded(image: np.ndarray, top: int, rows: int, stride: int) -> np.ndarray:
    """A band of `rows` rows and FLIP_REACH more on each side, channel by channel: [3, rows + 2 FLIP_REACH, stride] f32.

    Beyond the image its border is repeated, as in NVIDIA's program.
    """
    height, width = image.shape[:2]
    padded = np.empty((3, rows + 2 * FLIP_REACH, stride), np.float32)
    first, last = max(top - FLIP_REACH, 0), min(top + rows + FLIP_REACH, height)
    at = first - (top - FLIP_REACH)
    inside = padded[:, at : at + last - first]
    np.clip(image[first:last].transpose(2, 0, 1), 0.0, 1.0, out=inside[:, :, FLIP_REACH : FLIP_REACH + width])
    inside[:, :, :FLIP_REACH] = inside[:, :, FLIP_REACH, None]
    inside[:, :, FLIP_REACH + width :] = inside[:, :, FLIP_REACH + width - 1, None]
    padded[:, :at] = inside[:, :1]
    padded[:, at + last - first :] = inside[:, -1:]
    return padded


def modelled_ssim_drop(unlike: float) -> float:
    """SSIM lost against photos that are not there, from `unlike`, 1 - SSIM against the original's renders.

    A photo shares only a part of its structure with the original, and the rest cannot be lost:
    docs/results/tuning.md#lost_share

    >>> round(modelled_ssim_drop(0.02), 3)
    0.014
    """
    return LOST_SHARE * unlike


def ssim_bytes(width: int, height: int) -> int:
    """Bytes that `ssims` takes on the backend for images of this size."""
    return 4 * 8 * height * (-(-width // LANES) * LANES) + 4 * 5 * LANES


def ssims(backend: Backend, pairs: Pairs) -> list[float | None]:
    """SSIM of pairs of images of one size, mean over pixels and channels (Wang et al. 2004).

    It takes a Gaussian window of sigma 1.5, population covariance, a data range of 1, and only windows inside the
    image. scikit-image gives the same with `gaussian_weights=True, use_sample_covariance=False, data_range=1`.

    `pairs`: [H, W, 3] f32; clamped to [0, 1] here. Returns `None` for images with a side below 11 pixels.
    """
    if not pairs or min(pairs[0][0].shape[:2]) < SSIM_WINDOW:
        return [None] * len(pairs)
    height, width = pairs[0][0].shape[:2]
    windows = (height - SSIM_WINDOW + 1) * (width - SSIM_WINDOW + 1)
    pairs = _differing(pairs, SSIM_WINDOW - 1)
    height, width = pairs[0][0].shape[:2]
    rows, stride = height - SSIM_WINDOW + 1, -(-width // LANES) * LANES
    count = rows * stride
    plane = count + LANES
    shapes = ((SSIM_WINDOW,), (height, stride), (height, stride), (5, plane), (count,))
    arrays = []
    try:
        for shape in shapes:
            arrays.append(backend.array(shape, np.float32))
        taps, *images, moments, similar = arrays
        backend.write(taps, window())
        backend.fill(moments, 0)  # the kernel reads beyond the last row, but does not use it
        padded = np.zeros((height, stride), np.float32)
        totals = [0.0] * len(pairs)
        for channel in range(3):
            held: list[np.ndarray | None] = [None, None]
            for place, pair in enumerate(pairs):
                for slot, image in enumerate(pair):
                    if held[slot] is image:
                        continue
                    np.clip(image[..., channel], 0.0, 1.0, out=padded[:, :width])
                    backend.write(images[slot], padded)
                    held[slot] = image
                backend.launch("ssim_columns", (count,), count, stride, plane, taps, *images, moments)
                backend.launch("ssim_rows", (count,), count, plane, taps, moments, similar)
                inside = backend.read(similar).reshape(rows, stride)[:, : width - SSIM_WINDOW + 1]
                # All other windows have two equal images, and an SSIM of 1.
                totals[place] += (float(inside.sum(dtype=np.float64)) + windows - inside.size) / windows
        return [total / 3 for total in totals]
    finally:
        for array in arrays:
            array.release()
