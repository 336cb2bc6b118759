"""The memory limit of a run, the memory that the system reports, and large arrays in memory or in scratch files."""
