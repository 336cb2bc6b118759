"""How much work a search by measured costs spends: counted, never timed."""

from __future__ import annotations

from dataclasses import dataclass


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
        Steps a round, as for `refit_colours`.
    steps : int
        Whole results that are measured, at most while something holds.
    close : float
        Excess (log of loss over limit) that ends the search when it is no farther below the target: 0.03 are about 1.5 % of
        the bytes.
    views : int
        Most scored poses.
    """

    keep: float
    refit_rounds: int
    subsets: int
    steps: int
    close: float
    views: int


EFFORTS = {
    "fast": Effort(keep=0.66, refit_rounds=1, subsets=3, steps=2, close=0.08, views=48),
    "balanced": Effort(keep=0.8, refit_rounds=1, subsets=3, steps=4, close=0.04, views=96),
    "thorough": Effort(keep=0.88, refit_rounds=2, subsets=4, steps=6, close=0.015, views=400),
}
