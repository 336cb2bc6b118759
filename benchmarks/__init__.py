"""Measurements of speed, memory and of the tests themselves; see README.md."""
