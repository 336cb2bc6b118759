"""A measured curve of bytes and loss, read between its points: what other points cost against it."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

LEAST_LOSS = 0.001
"""Losses are read on a log scale, like bytes (a straight line is then a power law, which such curves nearly are); points below
this many dB are left out."""
SLACK = 1e-9
"""The curve's own points lie on it, however their logarithms are rounded."""


class Curve:
    """Bytes and loss of one method at several sizes.

    Parameters
    ----------
    points : iterable of (size, loss)
        In bytes and dB.
    """

    def __init__(self, points: Iterable[tuple[int, float]]) -> None:
        known = sorted((size, loss) for size, loss in points if loss >= LEAST_LOSS)
        self._sizes = np.log([size for size, _ in known])
        # Noise may leave a smaller file the better one: what a loss costs is then the smaller file.
        self._losses = np.minimum.accumulate(np.log([loss for _, loss in known]))

    def loss(self, size: int) -> float | None:
        """Loss of a file of so many bytes, dB; None beyond the curve's ends."""
        place = float(np.log(size))
        if not len(self._sizes) or not self._sizes[0] - SLACK <= place <= self._sizes[-1] + SLACK:
            return None
        return float(np.exp(np.interp(place, self._sizes, self._losses)))

    def size(self, loss: float) -> float | None:
        """Bytes at a loss, the fewest there; None beyond the curve's ends."""
        place = float(np.log(max(loss, 1e-12)))
        if not len(self._sizes) or not self._losses[-1] - SLACK <= place <= self._losses[0] + SLACK:
            return None
        after = int(np.flatnonzero(self._losses <= place + SLACK)[0])
        if after == 0:
            return float(np.exp(self._sizes[0]))
        ends = slice(after - 1, after + 1)
        return float(np.exp(np.interp(-place, -self._losses[ends], self._sizes[ends])))
