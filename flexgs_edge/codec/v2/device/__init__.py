"""Version 2 coded and decoded by kernels."""
