"""`study rate`: bytes against quality of each method, and how many bytes each part of `best` saves."""
