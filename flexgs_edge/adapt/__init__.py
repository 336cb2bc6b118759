"""FOA: candidates, search and targets; pure control flow over an `Evaluator` that is given to it."""

from flexgs_edge.adapt.search import (
    CANDIDATES,
    REFINE_STEPS,
    Evaluator,
    Scored,
    SearchResult,
    Step,
    adapt,
    measure_fixed,
)
from flexgs_edge.adapt.targets import Judge, MaxDrop, MaxSize, Measurement, MinFidelity, Target, WorstToo, min_ratio

__all__ = [
    "CANDIDATES",
    "REFINE_STEPS",
    "Evaluator",
    "Judge",
    "MaxDrop",
    "MaxSize",
    "Measurement",
    "MinFidelity",
    "Scored",
    "SearchResult",
    "Step",
    "Target",
    "WorstToo",
    "adapt",
    "measure_fixed",
    "min_ratio",
]
