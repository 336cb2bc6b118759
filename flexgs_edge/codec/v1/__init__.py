"""Container version 1: bit-packed quantized scenes, which the method `paper` makes."""
