"""Compression into other programs' formats."""
