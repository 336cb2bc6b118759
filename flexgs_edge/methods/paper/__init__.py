"""The method of FlexGaussian (ACM MM 2025): pruning by score (ADP), mixed-precision quantization (MPQ) and search (FOA)."""
