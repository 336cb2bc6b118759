"""Experiments on a user's own scenes, as tables, charts and one page."""
