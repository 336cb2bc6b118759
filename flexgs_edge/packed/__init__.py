"""Integers of the method `paper`: a value is a b-bit code in a range."""
