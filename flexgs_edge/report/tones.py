"""The colours of error maps: dark for no error, through violet and orange to near white."""

from __future__ import annotations

import numpy as np

ERROR_SCALE = 0.1
"""Differences from this share of the full range up get the brightest colour. All maps use the same scale, so that two pages can
be compared. At a fidelity of 40 dB a typical difference is a tenth of it, and half of it at edges."""
FLIP_SCALE = 0.5
"""FLIP from this value up gets the brightest colour. At a drop of 1 dB a typical pixel has a tenth to a fifth of it, and one in a
hundred 0.15 to 0.3."""
# Brightness rises evenly, so that the map can also be read in grey.
_STOPS = ((8, 6, 20), (74, 24, 110), (176, 50, 92), (240, 120, 40), (255, 206, 90), (255, 252, 232))


def ramp() -> np.ndarray:
    """Colours of 256 even steps from no error to the largest, [256, 3] u8."""
    at = np.linspace(0, len(_STOPS) - 1, 256)
    stops = np.array(_STOPS, np.float64).T
    return np.stack([np.rint(np.interp(at, range(len(_STOPS)), channel)) for channel in stops], axis=1).astype(np.uint8)


def css_ramp() -> str:
    """The colours as a CSS gradient."""
    return "linear-gradient(90deg," + ",".join(f"rgb({r} {g} {b})" for r, g, b in _STOPS) + ")"


def error_map(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Largest difference over the channels of two [H, W, 3] images, divided by `ERROR_SCALE`: [H, W] f32 from 0 to 1."""
    difference = np.abs(np.clip(image, 0.0, 1.0) - np.clip(reference, 0.0, 1.0)).max(axis=2)
    shares: np.ndarray = np.minimum(difference / np.float32(ERROR_SCALE), np.float32(1.0))
    return shares
