"""The first layer of a file in a descent: in some steps it is drawn alone, as a viewer draws it until the rest has come."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from flexgs_edge.kernels.backend import Backend
from flexgs_edge.scene.growth import growth

EVERY, WEIGHT = 3, 0.25
"""One step with the first layer alone comes after so many of the whole scene, with this share of the loss. The layer alone loses
four times as much as the whole scene, and steps follow what was lost before: docs/results/web.md#first-layer"""
HIDDEN = -8.0
"""Logit of an opacity below 1/255, which no view shows."""


@dataclass(frozen=True)
class FirstLayer:
    """Rows of a descent that its first layer has.

    Parameters
    ----------
    inside : np.ndarray
        [n] bool, rows of the layer; at least one.
    """

    inside: np.ndarray

    def draw(self, backend: Backend, base: int, count: int, log_scales: Any, logits: Any) -> None:
        """Change what a chunk of `count` rows from `base` on is drawn from: rows of the layer grow, others are hidden.

        Parameters
        ----------
        backend : Backend
        base, count : int
            Rows of the chunk.
        log_scales, logits : array of the backend
            [3, stride] and [stride] f32.
        """
        grown = backend.read(log_scales) + growth(int(np.count_nonzero(self.inside)), len(self.inside))
        backend.write(log_scales, grown.reshape(-1))
        shown = backend.read(logits).reshape(-1)
        shown[:count][~self.inside[base : base + count]] = HIDDEN
        backend.write(logits, shown)
