"""Experiments on a user's own scenes, written as tables, charts and one page. The rest of the package does not need them."""
