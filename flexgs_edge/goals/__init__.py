"""The targets of a search, and the points that it measured: plain records and arithmetic, without arrays."""
