"""A local model of the excess, linear in prune rate and SH rate.

It is fitted to the points measured so far and tells the search which point is worth measuring next.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from flexgs_edge.goals.choice import Choice

PRIOR_SLOPES = (5.0, 2.0)
"""Excess (log of loss over limit) for each unit of prune rate and SH rate, before anything is measured:
docs/results/tuning.md#prior_slopes"""
PRIOR_WEIGHT = 1e-3
"""Weight of the prior slopes, in measured points at the limit. They decide only where points leave a slope open."""
WIDTH = 0.5
"""Excess at which a measured point weighs 1/e of one at the limit, because the model need only be right near the limit."""


@dataclass(frozen=True)
class LossModel:
    """excess = constant + prune * p + sh * s, with prune rate p and SH rate s in 0..1."""

    constant: float
    prune: float
    sh: float

    @classmethod
    def fit(cls, points: list[tuple[Choice, float]]) -> LossModel:
        """Fit `points` by weighted least squares; the prior slopes decide where points leave a direction open.

        Slopes stay at or above zero, because more compression never gains quality.
        """
        rows = [(c.prune / 1000.0, c.sh / 1000.0, e, math.exp(-min(abs(e) / WIDTH, 6.0))) for c, e in points]
        weight = math.fsum(w for *_, w in rows)
        mean_p = math.fsum(w * p for p, _, _, w in rows) / weight
        mean_s = math.fsum(w * s for _, s, _, w in rows) / weight
        mean_e = math.fsum(w * e for _, _, e, w in rows) / weight
        pp = PRIOR_WEIGHT + math.fsum(w * (p - mean_p) ** 2 for p, _, _, w in rows)
        ss = PRIOR_WEIGHT + math.fsum(w * (s - mean_s) ** 2 for _, s, _, w in rows)
        ps = math.fsum(w * (p - mean_p) * (s - mean_s) for p, s, _, w in rows)
        pe = PRIOR_WEIGHT * PRIOR_SLOPES[0] + math.fsum(w * (p - mean_p) * (e - mean_e) for p, _, e, w in rows)
        se = PRIOR_WEIGHT * PRIOR_SLOPES[1] + math.fsum(w * (s - mean_s) * (e - mean_e) for _, s, e, w in rows)
        determinant = pp * ss - ps * ps
        slope_p = max((pe * ss - se * ps) / determinant, 0.0)
        slope_s = max((se * pp - pe * ps) / determinant, 0.0)
        return cls(mean_e - slope_p * mean_p - slope_s * mean_s, slope_p, slope_s)

    def predict(self, choice: Choice) -> float:
        """Expected excess at `choice`."""
        return self.constant + (self.prune * choice.prune + self.sh * choice.sh) / 1000.0
