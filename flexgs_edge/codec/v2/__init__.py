"""Container version 2: entropy-coded grids of the method `best`."""
