"""Bit-packed scenes: each value is a code of b bits within a range. The method `paper` makes these."""
