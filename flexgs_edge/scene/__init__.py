"""A set of Gaussians, wherever it came from: lazy sources, fields and checks."""
