"""One multiplier decides for every Gaussian: removed, or kept with SH up to some degree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flexgs_edge.score.removal import RemovalCosts

SH_FACTOR = 2.0
"""Costs of dropped SH count this much. They are measured one Gaussian at a time, but neighbours on a surface lose the same
part of their view dependence and their errors add up: bytes at 1 dB fall by 4 % on fox and stay on the sample scene
against a factor of 1."""
REMOVAL_FACTOR = 1.3
"""Costs of removal count this much, for the same reason: what goes in one cut is measured one by one."""


@dataclass(frozen=True)
class BitModel:
    """What a Gaussian costs, from the coder's own statistics.

    Parameters
    ----------
    base : float
        Bits of a Gaussian without SH.
    bands : tuple of float
        Bits that each SH degree from 1 adds.
    """

    base: float = 50.0
    bands: tuple[float, ...] = (10.0, 8.0, 8.0, 8.0)

    def of_degree(self, degree: int) -> float:
        """Bits of a Gaussian kept with SH up to `degree`."""
        return self.base + sum(self.bands[:degree])


def choose(costs: RemovalCosts, bits: BitModel, multiplier: float) -> tuple[np.ndarray, np.ndarray]:
    """The cheapest of {removed, SH 0, ..., SH D} under cost + multiplier * bits, each Gaussian for itself.

    Gaussians that no pose sees stay, without SH: nothing is known of them.

    Parameters
    ----------
    costs : RemovalCosts
        Squared errors.
    bits : BitModel
    multiplier : float
        Squared error that a bit is worth.

    Returns
    -------
    tuple of np.ndarray
        [n] bool kept, [n] u8 SH degree kept.
    """
    top = len(costs.sh)
    lagrangian = [SH_FACTOR * costs.sh[level] + multiplier * bits.of_degree(level) for level in range(top)]
    lagrangian.append(np.full(len(costs.removal), multiplier * bits.of_degree(top)))
    degrees = np.argmin(lagrangian, axis=0).astype(np.uint8)
    keep = REMOVAL_FACTOR * costs.removal >= np.min(lagrangian, axis=0)
    unseen = costs.weight2 <= 0
    keep[unseen] = True
    degrees[unseen] = 0
    return keep, degrees


def choose_one_degree(costs: RemovalCosts, bits: BitModel, multiplier: float) -> tuple[np.ndarray, np.ndarray]:
    """As `choose`, but with one SH degree for all that are kept: for formats where SH that are zero take as much as any."""
    top = len(costs.sh)
    nothing = np.zeros_like(costs.removal)
    removal = REMOVAL_FACTOR * costs.removal
    lagrangian = [
        (SH_FACTOR * costs.sh[level] if level < top else nothing) + multiplier * bits.of_degree(level)
        for level in range(top + 1)
    ]
    degree = int(np.argmin([np.minimum(removal, whole).sum() for whole in lagrangian]))
    keep = removal >= lagrangian[degree]
    keep[costs.weight2 <= 0] = True
    return keep, np.full(len(keep), degree, np.uint8)


def drop_bands(
    planes: dict[str, np.ndarray], degrees: np.ndarray, sh_mean: np.ndarray, y0: float
) -> dict[str, np.ndarray]:
    """Clear SH above `degrees` ([n]) and add the cleared bands' mean colour (`sh_mean`, [D, 3, n]) to the constant."""
    top = len(sh_mean)
    if top == 0:
        return planes
    lower = np.minimum(degrees, top - 1).astype(np.int64)
    mean = np.take_along_axis(sh_mean, lower[None, None], axis=0)[0]
    dc = planes["sh_dc"] + np.where(degrees < top, mean, np.float32(0)) / np.float32(y0)
    rest = planes["sh_rest"].reshape(3, (top + 1) ** 2 - 1, -1).copy()
    for level in range(1, top + 1):
        rest[:, level * level - 1 : (level + 1) ** 2 - 1] *= degrees >= level
    return {**planes, "sh_dc": dc.astype(np.float32), "sh_rest": rest.reshape(planes["sh_rest"].shape)}
