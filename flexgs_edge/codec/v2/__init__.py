"""Container version 2: entropy-coded grid scenes, which the method `best` makes."""
