"""Repeats the experiments of the FlexGaussian paper on a scene; see docs/results/paper.md."""
