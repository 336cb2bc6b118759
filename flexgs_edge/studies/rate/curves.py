"""A rate-distortion curve through measured points, so that other points can be compared at equal bytes or equal loss."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

LEAST_LOSS = 0.001
"""Points with less loss than this, in dB, are left out. Loss and bytes are interpolated on log scales, because such curves are
nearly power laws."""
SLACK = 1e-9
"""Tolerance, so that the curve's own points lie on it in spite of rounding."""


class Curve:
    """Bytes and loss of one method at several sizes.

    `points`: bytes and dB.
    """

    def __init__(self, points: Iterable[tuple[int, float]]) -> None:
        known = sorted((size, loss) for size, loss in points if loss >= LEAST_LOSS)
        self._sizes = np.log([size for size, _ in known])
        # With noise a smaller file may be the better one. The smaller file then counts.
        self._losses = np.minimum.accumulate(np.log([loss for _, loss in known]))

    def loss(self, size: int) -> float | None:
        """Loss in dB of a file of `size` bytes; None beyond the curve's ends."""
        place = float(np.log(size))
        if not len(self._sizes) or not self._sizes[0] - SLACK <= place <= self._sizes[-1] + SLACK:
            return None
        return float(np.exp(np.interp(place, self._sizes, self._losses)))

    def size(self, loss: float) -> float | None:
        """Fewest bytes at `loss` dB; None beyond the curve's ends."""
        place = float(np.log(max(loss, 1e-12)))
        if not len(self._sizes) or not self._losses[-1] - SLACK <= place <= self._losses[0] + SLACK:
            return None
        after = int(np.flatnonzero(self._losses <= place + SLACK)[0])
        if after == 0:
            return float(np.exp(self._sizes[0]))
        ends = slice(after - 1, after + 1)
        return float(np.exp(np.interp(-place, -self._losses[ends], self._sizes[ends])))
