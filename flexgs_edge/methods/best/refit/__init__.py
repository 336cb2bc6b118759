"""Refits: the remaining Gaussians are fitted to renders of the original after pruning and quantization."""
