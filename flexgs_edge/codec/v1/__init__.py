"""Container version 1: bit-packed codes of the method `paper`."""
