"""What pruning and quantization broke, mended in the values that are kept: never changes the choice of Gaussians."""

from flexgs_edge.refit.colour import normal_bytes, normal_sums, refit_colours, step_colours
from flexgs_edge.refit.descent import descent_bytes
from flexgs_edge.refit.distil import Schedule, distil

__all__ = [
    "Schedule",
    "descent_bytes",
    "distil",
    "normal_bytes",
    "normal_sums",
    "refit_colours",
    "step_colours",
]
