"""What pruning and quantization broke, mended in the values that are kept: never changes the choice of Gaussians."""

from flexgs_edge.refit.colour import normal_bytes, normal_sums, refit_colours, step_colours

__all__ = ["normal_bytes", "normal_sums", "refit_colours", "step_colours"]
