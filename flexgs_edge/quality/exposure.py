"""Exposure and white balance of a photo, fitted to a render: one gain per channel, in linear light.

Cameras choose both anew for each photo, and a scene is trained to one of them. A photo of another exposure than the scene's
is far from any render, and its drop would hide what compression loses.
"""

from __future__ import annotations

from math import isqrt

import numpy as np

from flexgs_edge.quality.psnr import drop, mse

DARK, BRIGHT = 2 / 255, 253 / 255  # Values outside these may be clipped, and tell no gain
FIT_PIXELS = 1 << 16
"""Every n-th pixel in both directions is fitted, so that at least this many are, or all of a smaller picture."""
LEAST_GAIN = 0.5
"""A fit counts if it lowers the error by this much, dB. Without a smaller one, a drop of 1 dB reads as .9 dB or more."""


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
    light: np.ndarray = np.where(values > 0.04045, ((values + 0.055) / 1.055) ** 2.4, values / 12.92)
    return light


def _encoded(light: np.ndarray) -> np.ndarray:
    """SRGB values of light, f32, clipped at 1."""
    light = np.minimum(light, 1.0)
    return np.where(light > 0.0031308, 1.055 * light ** (1 / 2.4) - 0.055, 12.92 * light).astype(np.float32)
