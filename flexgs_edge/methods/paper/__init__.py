"""The method of FlexGaussian (ACM MM 2025): ADP, MPQ and FOA."""
