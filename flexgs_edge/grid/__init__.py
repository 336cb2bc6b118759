"""Scenes on a grid: integer codes, each of which stands for a multiple of a step size.

The method `best` codes these.
"""
