"""The default method, `best`: measured costs, rounds of pruning, one multiplier, one search (docs/best.md)."""
