"""A sample of a scene's positions."""

from __future__ import annotations

import numpy as np

from flexgs_edge.scene.source import SceneSource

SAMPLE_ROWS = 4096
"""Most Gaussians whose positions tell which poses see which part of a scene, and how much of it."""


def some_positions(source: SceneSource, most: int = SAMPLE_ROWS) -> np.ndarray:
    """[3, n] f64, world coordinates of at most `most` rows, evenly spread over the scene's rows."""
    rows = np.arange(0, source.count, max(-(-source.count // most), 1))
    positions: np.ndarray = source.read(rows, ["means"])["means"].astype(np.float64) + source.origin[:, None]
    return positions
