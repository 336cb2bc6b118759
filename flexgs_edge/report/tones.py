"""The colours of error maps: dark for no error, through violet and orange to near white."""

from __future__ import annotations

import numpy as np

ERROR_SCALE = 0.1
"""Difference that is as bright as the map gets, as a share of the full range: the same for all maps, so that two pages can be
compared. At a fidelity of 40 dB the typical difference is a tenth of it, at edges a half."""
# Brightness rises evenly (checked by eye in grey), so that the map also reads without colour.
_STOPS = ((8, 6, 20), (74, 24, 110), (176, 50, 92), (240, 120, 40), (255, 206, 90), (255, 252, 232))


def ramp() -> np.ndarray:
    """[256, 3] u8: colour of each of 256 even steps."""
    at = np.linspace(0, len(_STOPS) - 1, 256)
    stops = np.array(_STOPS, np.float64).T
    return np.stack([np.rint(np.interp(at, range(len(_STOPS)), channel)) for channel in stops], axis=1).astype(np.uint8)


def css_ramp() -> str:
    """The same as a CSS gradient."""
    return "linear-gradient(90deg," + ",".join(f"rgb({r} {g} {b})" for r, g, b in _STOPS) + ")"


def error_map(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """[H, W] f32 from 0 to 1: the largest difference of the channels of two [H, W, 3] images, in units of `ERROR_SCALE`."""
    difference = np.abs(np.clip(image, 0.0, 1.0) - np.clip(reference, 0.0, 1.0)).max(axis=2)
    shares: np.ndarray = np.minimum(difference / np.float32(ERROR_SCALE), np.float32(1.0))
    return shares
