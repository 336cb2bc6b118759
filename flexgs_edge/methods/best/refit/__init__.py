"""What pruning and quantization broke, mended in the values that are kept."""
