"""Quality from a sample of tiles, with an interval: the squared error of the pictures without looking at all of them.

The tiles of each view, most expected first, are cut into strata that are expected to hold equal sums of squared error, and two
are drawn from each. So a tile is the likelier to be drawn the more is expected of it, and the two of a stratum tell its variance
without a model. What is expected may come from any earlier picture of the same views, such as a step of a search: wrong
expectations make the interval wide, not wrong.
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
"""Standard errors that a two-sided interval of 95 % reaches to either side."""
FLOOR = 0.2
"""Share of a view's mean that is expected of every tile besides: one that was exact before need not be so now.
docs/results/tuning.md#floor"""
DECIBEL = 10.0 / math.log(10.0)
"""dB of a factor e of the error."""


def tile_errors(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Sums of squared error by tile of two [H, W, 3] images clamped to [0, 1].

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
    """[tiles] i64, values (pixels times channels) of each tile: those at the right and lower edge may be cut."""
    down = np.minimum(TILE, height - np.arange(0, height, TILE))
    across = np.minimum(TILE, width - np.arange(0, width, TILE))
    return (3 * down[:, None] * across).reshape(-1)


@dataclass(frozen=True)
class Estimate:
    """What a sample of tiles says.

    Parameters
    ----------
    error : float
        Mean squared error, mean over the views.
    error_deviation : float
        Its standard error.
    fidelity : float or None
        Mean over the views of their PSNRs, dB; views in whose tiles no error was found are left out.
    half_width : float
        The 95 % interval of the fidelity reaches so many dB to either side.
    share : float
        Pixels that were looked at, of all.
    """

    error: float
    error_deviation: float
    fidelity: float | None
    half_width: float
    share: float

    def covers(self, fidelity: float | None) -> bool:
        """Whether the interval holds a fidelity (with the slack that the rounding of sums takes)."""
        if fidelity is None or self.fidelity is None:
            return fidelity is self.fidelity
        return abs(fidelity - self.fidelity) <= self.half_width + 1e-9


class TileSampler:
    """Draws tiles of some views and estimates from them.

    Parameters
    ----------
    values : sequence of np.ndarray
        `tile_values` of each view.
    share : float
        Of the pixels of each view to look at, at most (above 0, at most 1); but four tiles a view at the least.
    expected : sequence of np.ndarray, optional
        Squared errors by tile of an earlier picture of each view, in any unit. Without them strata are runs of neighbours.
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
            # By whole tiles, however many of those drawn are cut at an edge: never more than the share.
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
        """[n] i64, tiles counted through all views (the first view's first); the same for the same seed."""
        keys = np.random.default_rng(seed).random(len(self._tiles))
        order = np.lexsort((keys, self._stratum))
        place = np.arange(len(order)) - self._starts[self._stratum]
        tiles: np.ndarray = self._tiles[order[place < self._drawn[self._stratum]]]
        return tiles

    def estimate(self, drawn: np.ndarray, errors: np.ndarray) -> Estimate:
        """The figures of all tiles.

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
        # The logarithm of an estimate with a variance is too small in the mean: the delta method's second term.
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
    """Tiles in strata for `pairs` draws of two, of equal sums of weight: the heaviest first, ties in order of place."""
    count, pairs = len(weights), max(pairs, 2)
    order = np.argsort(-weights, kind="stable")
    below = np.concatenate([np.cumsum(weights[order][::-1])[::-1], [0.0]])  # weight from each place on
    strata, start = [], 0
    while start < count:
        stop = count
        if pairs > 1:
            # What is left is shared anew each time: a heavy stratum of two tiles leaves the others less.
            goal = below[start] * (1 - 1 / pairs)
            stop = max(int(np.searchsorted(-below, -goal * (1 + 1e-12))), start + 2)
            stop = count if count - stop < 2 else stop
        strata.append(order[start:stop])
        start, pairs = stop, pairs - 1
    return strata
