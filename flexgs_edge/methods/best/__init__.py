"""The default method: measured costs, one multiplier, one search."""
