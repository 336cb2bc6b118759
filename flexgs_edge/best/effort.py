"""How much work a search by measured costs spends: counted, never timed."""

from __future__ import annotations

from dataclasses import dataclass

LEAST_VIEWS = 6
"""Poses a step of the refit at the least: steps after 3 poses each fitted fox's 24 scored ones ever better and all others ever
worse."""


@dataclass(frozen=True)
class Effort:
    """How much work a search spends; fixed counts.

    Parameters
    ----------
    keep : float
        Share of the Gaussians that stays in each round of the path.
    refit_rounds : int
        Rounds on all coefficients before SH are put on their grid (one on the constant follows).
    subsets : int
        Steps a round at most, as for `refit_colours`.
    steps : int
        Whole results that are measured, at most while something holds.
    close : float
        Excess (log of loss over limit) that ends the search when it is no farther below the target: 0.03 are about 1.5 % of
        the bytes.
    views : int
        Most scored poses.
    passes : float
        Times that the descent to the first whole result looks at every scored pose; 0: colours are refitted instead.
    """

    keep: float
    refit_rounds: int
    subsets: int
    steps: int
    close: float
    views: int
    passes: float = 0.0

    def subsets_of(self, poses: int) -> int:
        """Steps a round for so many scored poses."""
        return max(min(self.subsets, poses // LEAST_VIEWS), 1)


EFFORTS = {
    "fast": Effort(keep=0.8, refit_rounds=1, subsets=7, steps=1, close=0.08, views=48),
    "balanced": Effort(keep=0.88, refit_rounds=2, subsets=7, steps=2, close=0.05, views=96),
    "thorough": Effort(keep=0.9, refit_rounds=2, subsets=7, steps=5, close=0.02, views=400),
    "max": Effort(keep=0.8, refit_rounds=1, subsets=7, steps=2, close=0.05, views=96, passes=7.0),
}
