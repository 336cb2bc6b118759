"""Benchmarks of speed and memory, and checks of the tests themselves; see README.md."""
