"""Rate-distortion allocation: one multiplier decides for every Gaussian what happens to it.

A Gaussian is removed, or kept with SH up to some degree, whichever has the least cost + multiplier * bits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flexgs_edge.memory.rows import put_rows, read_ahead
from flexgs_edge.memory.storage import IN_MEMORY, Storage
from flexgs_edge.methods.best.costs import RemovalCosts

SH_FACTOR = 2.0
"""Factor on the costs of dropping SH. We measure them one Gaussian at a time. But neighbours on a surface lose the same
part of their view-dependent colour, and these errors add up: docs/results/tuning.md#sh_factor"""
REMOVAL_FACTOR = 1.3
"""Factor on the costs of removal, for the same reason: one cut removes many Gaussians, and we measure them one by one."""


@dataclass(frozen=True)
class BitModel:
    """Bits that a Gaussian takes in the file.

    The defaults are fixed. Asking the coder for its own bits near the answer takes time and does not make files smaller:
    docs/results/tuning.md#bitmodel
    """

    base: float = 50.0  # bits of a Gaussian without SH
    bands: tuple[float, ...] = (10.0, 8.0, 8.0, 8.0)  # bits that each SH degree from 1 adds

    def of_degree(self, degree: int) -> float:
        """Bits of a Gaussian kept with SH up to `degree`."""
        return self.base + sum(self.bands[:degree])


def choose(costs: RemovalCosts, bits: BitModel, multiplier: float) -> tuple[np.ndarray, np.ndarray]:
    """Choose the cheapest of {removed, SH 0, ..., SH D} by cost + multiplier * bits, for each Gaussian by itself.

    Gaussians that no pose sees stay, without SH, because no cost of theirs is known.

    `costs`: squared errors. `bits`: bits of a Gaussian by SH degree. `multiplier`: squared error that a bit is worth.
    Returns [n] bool kept, [n] u8 SH degree kept.
    """
    top, count = len(costs.sh), len(costs.removal)
    keep, degrees = np.empty(count, bool), np.empty(count, np.uint8)
    for rows, (removal, sh, weight2) in read_ahead(count, costs.removal, costs.sh, costs.weight2):
        lagrangian = [SH_FACTOR * sh[level] + multiplier * bits.of_degree(level) for level in range(top)]
        lagrangian.append(np.full(len(removal), multiplier * bits.of_degree(top)))
        unseen = weight2 <= 0
        degrees[rows] = np.where(unseen, 0, np.argmin(lagrangian, axis=0))
        keep[rows] = unseen | (REMOVAL_FACTOR * removal >= np.min(lagrangian, axis=0))
    return keep, degrees


def keep_one(keep: np.ndarray, costs: RemovalCosts) -> None:
    """Keep the row whose removal costs most (of equal ones the first), if `keep` has none that a pose sees.

    `keep`: [n] bool, from `choose` or `OneDegree`; changed in place. `costs`: squared errors.
    """
    dearest, most = 0, -1.0
    for rows, (removal, weight2) in read_ahead(len(keep), costs.removal, costs.weight2):
        here = np.where(weight2 > 0, removal, -1.0)
        if (keep[rows] & (weight2 > 0)).any():
            return
        if here.max() > most:
            dearest, most = rows.start + int(np.argmax(here)), float(here.max())
    if most >= 0:
        keep[dearest] = True


def keep_most(keep: np.ndarray, costs: RemovalCosts, most: int) -> None:
    """Keep no more than `most` rows: first go those that no pose sees, then those whose removal costs least.

    `keep`: [n] bool, from `choose` or `OneDegree`; changed in place. `costs`: squared errors. `most`: most
    rows.
    """
    over = int(np.count_nonzero(keep)) - most
    if over > 0:
        rows = np.flatnonzero(keep)
        worth = np.where(costs.weight2[rows] > 0, costs.removal[rows], -1.0)
        keep[rows[np.argsort(worth, kind="stable")[:over]]] = False


class OneDegree:
    """As `choose`, but with one SH degree for all rows, for formats in which zero SH take as many bytes as others.

    The degree never rises in a search: the costs of single rows say too much, and fine-tuning mends most of what SH were worth.
    """

    def __init__(self) -> None:
        self._most: int | None = None

    def __call__(self, costs: RemovalCosts, bits: BitModel, multiplier: float) -> tuple[np.ndarray, np.ndarray]:
        """See `choose`."""
        top = len(costs.sh)
        nothing = np.zeros_like(costs.removal)
        removal = REMOVAL_FACTOR * costs.removal
        lagrangian = [
            (SH_FACTOR * costs.sh[level] if level < top else nothing) + multiplier * bits.of_degree(level)
            for level in range((top if self._most is None else min(self._most, top)) + 1)
        ]
        self._most = int(np.argmin([np.minimum(removal, whole).sum() for whole in lagrangian]))
        keep = removal >= lagrangian[self._most]
        keep[costs.weight2 <= 0] = True
        return keep, np.full(len(keep), self._most, np.uint8)


def drop_bands(
    planes: dict[str, np.ndarray],  # [width, n] f32 by field; not changed
    rows: np.ndarray,  # [m] i64, ascending
    degrees: np.ndarray,  # [m] u8, the SH degree that each row keeps
    sh_mean: np.ndarray,  # [D, 3, n] f32, mean colour of the bands above each lower degree
    y0: float,  # value of the constant basis function
    storage: Storage = IN_MEMORY,  # where the new arrays live
) -> dict[str, np.ndarray]:
    """Take rows of planes and drop the SH above their degrees; the mean colour of these is added to the constant.

    Returns [width, m] f32 by field, in arrays of `storage`.
    """
    top = len(sh_mean)
    if top == 0:
        return {name: storage.take(values, rows) for name, values in planes.items()}
    kept = {name: storage.empty((len(planes[name]), len(rows)), np.float32) for name in ("sh_dc", "sh_rest")}
    # Taken and cleared in one pass: with scratch files, a second pass would write and read all planes again.
    for part, found in read_ahead(planes["means"].shape[1], sh_mean, planes["sh_dc"], planes["sh_rest"]):
        here = slice(*np.searchsorted(rows, (part.start, part.stop)).tolist())
        inside, some = rows[here] - part.start, degrees[here]
        means, colours, bands = (values.take(inside, axis=-1) for values in found)
        lower = np.minimum(some, top - 1).astype(np.int64)
        mean = np.take_along_axis(means, lower[None, None], axis=0)[0]
        put_rows(kept["sh_dc"], here, colours + np.where(some < top, mean, np.float32(0)) / np.float32(y0))
        bands = bands.reshape(3, (top + 1) ** 2 - 1, -1)
        for level in range(1, top + 1):
            bands[:, level * level - 1 : (level + 1) ** 2 - 1] *= some >= level
        put_rows(kept["sh_rest"], here, bands.reshape(len(kept["sh_rest"]), len(some)))
    return {name: kept[name] if name in kept else storage.take(values, rows) for name, values in planes.items()}
