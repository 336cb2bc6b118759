"""Scenes of which only a part is there: its Gaussians are drawn larger, so that they fill the gaps of the others."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from flexgs_edge.scene.source import Planes, Rows, SceneSource, WrappedSource

GROWTH_POWER = 0.125
"""Power by which scales grow with the number of rows that belong to a scene over those that are there:
docs/results/tuning.md#layers"""


def growth(there: int, whole: int) -> np.float32:
    """What the log-scales of `there` rows (above 0) grow by when they stand for a scene of `whole` rows."""
    return np.float32(GROWTH_POWER * math.log(whole / there))


class GrownSource(WrappedSource):
    """A part of a scene of `whole` rows, grown to stand for all of it."""

    def __init__(self, parent: SceneSource, whole: int) -> None:
        super().__init__(parent)
        self._growth = growth(max(parent.count, 1), whole)

    def read(self, rows: Rows, fields: Sequence[str], out: Planes | None = None) -> Planes:
        """See `SceneSource.read`."""
        planes = self.parent.read(rows, fields, out)
        if "log_scales" in planes:
            planes["log_scales"] += self._growth
        return planes
