"""Estimates the squared error of pictures from a sample of their tiles, with a confidence interval.

The tiles of each view are sorted by expected error and cut into strata with equal sums of it. Two tiles are drawn from
each stratum. So tiles with much expected error are drawn more often, and the two tiles of a stratum tell its variance
without a model. Expected errors may come from any earlier picture of the same views, such as a step of a search. If they
are wrong, the interval gets wider but stays valid.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexgs_edge.constants import TILE
from flexgs_edge.errors import InputError
from flexgs_edge.quality.psnr import mean_psnr, psnr

NORMAL_95 = 1.959964
"""Half-width of a two-sided 95 % interval, in standard errors."""
FLOOR = 0.2
"""Share of a view's mean error that we also expect of every tile, because an exact tile need not stay exact.
docs/results/tuning.md#floor"""
DECIBEL = 10.0 / math.log(10.0)
"""dB for a factor e in the error."""


def tile_errors(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Sums of squared error by tile, between two [H, W, 3] images clamped to [0, 1].

    Returns
    -------
    np.ndarray
        [tiles] f64, row by row.
    """
    if image.shape != reference.shape:
        raise InputError(
            f"images of shapes {reference.shape} and {image.shape} cannot be compared: expected equal ones"
        )
    height, width = image.shape[:2]
    sums = np.empty((-(-height // TILE), -(-width // TILE)))
    columns = np.arange(0, width, TILE)
    for row, top in enumerate(range(0, height, TILE)):
        apart = np.clip(image[top : top + TILE], 0.0, 1.0).astype(np.float64)
        apart -= np.clip(reference[top : top + TILE], 0.0, 1.0)
        sums[row] = np.add.reduceat(np.square(apart, out=apart).sum(axis=(0, 2)), columns)
    return sums.reshape(-1)


def tile_values(height: int, width: int) -> np.ndarray:
    """[tiles] i64, values (pixels times channels) of each tile. Tiles at the right and lower edge may be smaller."""
    down = np.minimum(TILE, height - np.arange(0, height, TILE))
    across = np.minimum(TILE, width - np.arange(0, width, TILE))
    return (3 * down[:, None] * across).reshape(-1)


@dataclass(frozen=True)
class Estimate:
    """An estimate from a sample of tiles.

    Parameters
    ----------
    error : float
        Mean squared error, averaged over the views.
    error_deviation : float
        Its standard error.
    fidelity : float or None
        Mean PSNR over the views, dB. Views without any error in the drawn tiles are left out.
    half_width : float
        Half-width of the 95 % interval of the fidelity, dB.
    share : float
        Share of the pixels that were looked at.
    """

    error: float
    error_deviation: float
    fidelity: float | None
    half_width: float
    share: float

    def covers(self, fidelity: float | None) -> bool:
        """Whether the interval contains a fidelity, with some slack for rounding of sums."""
        if fidelity is None or self.fidelity is None:
            return fidelity is self.fidelity
        return abs(fidelity - self.fidelity) <= self.half_width + 1e-9


class TileSampler:
    """Draws tiles of some views and makes estimates from them.

    Parameters
    ----------
    values : sequence of np.ndarray
        `tile_values` of each view.
    share : float
        Most pixels of each view to look at, as a share (above 0, at most 1). At least four tiles a view are drawn.
    expected : sequence of np.ndarray, optional
        Squared errors by tile of an earlier picture of each view, in any unit. By default strata are runs of neighbours.
    """

    def __init__(
        self, values: Sequence[np.ndarray], share: float, expected: Sequence[np.ndarray] | None = None
    ) -> None:
        if not 0.0 < share <= 1.0:
            raise InputError(f"a sample of {share:g} of the pixels: expected a share above 0 and at most 1")
        self._values = np.concatenate(values)
        self._view_values = np.array([view.sum() for view in values], np.float64)
        strata: list[np.ndarray] = []
        views: list[int] = []
        first = 0
        for view, of_view in enumerate(values):
            weights = np.ones(len(of_view)) if expected is None else _floored(expected[view])
            # Edge tiles count as whole ones, so that we never look at more than the share.
            pairs = int(share * self._view_values[view] / (2 * of_view.max()))
            for stratum in _strata(weights, pairs):
                strata.append(first + stratum)
                views.append(view)
            first += len(of_view)
        self._sizes = np.array([len(stratum) for stratum in strata])
        self._views = np.array(views)
        self._tiles = np.concatenate(strata)
        self._stratum = np.repeat(np.arange(len(strata)), self._sizes)
        self._starts = np.concatenate([[0], np.cumsum(self._sizes)[:-1]])
        self._drawn = np.minimum(self._sizes, 2) if share < 1.0 else self._sizes

    def draw(self, seed: int) -> np.ndarray:
        """[n] i64, drawn tiles, numbered through all views. The same seed gives the same tiles."""
        keys = np.random.default_rng(seed).random(len(self._tiles))
        order = np.lexsort((keys, self._stratum))
        place = np.arange(len(order)) - self._starts[self._stratum]
        tiles: np.ndarray = self._tiles[order[place < self._drawn[self._stratum]]]
        return tiles

    def estimate(self, drawn: np.ndarray, errors: np.ndarray) -> Estimate:
        """Estimate the figures of all tiles.

        Parameters
        ----------
        drawn : np.ndarray
            From `draw`.
        errors : np.ndarray
            [n] f64, sums of squared error of these tiles.
        """
        starts = np.concatenate([[0], np.cumsum(self._drawn)[:-1]])
        sums = np.add.reduceat(errors, starts)
        squares = np.add.reduceat(np.square(errors - np.repeat(sums / self._drawn, self._drawn)), starts)
        totals = sums * (self._sizes / self._drawn)
        spread = squares / np.maximum(self._drawn - 1, 1)
        variances = self._sizes * (self._sizes - self._drawn) * spread / self._drawn
        views = len(self._view_values)
        means = np.bincount(self._views, totals, views) / self._view_values
        variance = np.bincount(self._views, variances, views) / np.square(self._view_values)
        known = means > 0
        relative = variance[known] / np.square(means[known])
        # The log of a noisy estimate is too small on average: this is the second term of the delta method.
        plain = mean_psnr([psnr(float(value)) for value in means])
        fidelity = None if plain is None else plain - DECIBEL / 2 * float(relative.mean())
        return Estimate(
            error=float(means.mean()),
            error_deviation=math.sqrt(float(variance.sum())) / views,
            fidelity=fidelity,
            half_width=NORMAL_95 * DECIBEL * math.sqrt(float(relative.sum())) / max(int(known.sum()), 1),
            share=float(self._values[drawn].sum() / self._values.sum()),
        )


def _floored(expected: np.ndarray) -> np.ndarray:
    mean = float(expected.mean())
    return expected + FLOOR * mean if mean > 0 else np.ones(len(expected))


def _strata(weights: np.ndarray, pairs: int) -> list[np.ndarray]:
    """Cut tiles into strata of equal weight for `pairs` draws of two. Heavy tiles come first, and ties go by place."""
    count, pairs = len(weights), max(pairs, 2)
    order = np.argsort(-weights, kind="stable")
    below = np.concatenate([np.cumsum(weights[order][::-1])[::-1], [0.0]])  # weight of all tiles from each place on
    strata, start = [], 0
    while start < count:
        stop = count
        if pairs > 1:
            # The rest is shared anew each time, because a stratum of two heavy tiles leaves less for the others.
            goal = below[start] * (1 - 1 / pairs)
            stop = max(int(np.searchsorted(-below, -goal * (1 + 1e-12))), start + 2)
            stop = count if count - stop < 2 else stop
        strata.append(order[start:stop])
        start, pairs = stop, pairs - 1
    return strata
