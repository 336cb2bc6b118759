"""`study rate`: bytes against quality of each method."""
