"""What pruning and quantization broke, mended in the values that are kept: never changes the choice of Gaussians."""

from flexgs_edge.refit.colour import NormalSums, normal_bytes, refit_colours, step_colours

__all__ = ["NormalSums", "normal_bytes", "refit_colours", "step_colours"]
