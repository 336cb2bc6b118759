"""Experiments on a user's own scenes: many settings measured by one judge, as tables, charts and one page.

`bench.py` opens a scene and measures settings, `tables.py`, `charts.py` and `page.py` write what was found, `folder.py` gives
the finished folder its name; each study is a module of its own that says what to measure.
Functions are imported from their modules: a name here would hide the module of the same name.
"""
