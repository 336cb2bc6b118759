"""Integers of the method `best`: a value is an integer times a step size."""
