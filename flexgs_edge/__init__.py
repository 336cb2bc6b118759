"""NumPy + OpenCL toolkit that compresses trained 3D Gaussian splatting scenes.

The Python API has the words of the command line::

    import flexgs_edge

    result = flexgs_edge.compress("point_cloud.ply", "scene.fgs", max_drop=1.0) print(result.size, result.quality.drop) arrays =
    flexgs_edge.decode("scene.fgs").arrays()

Names are imported when they are first used, so that ``import flexgs_edge`` costs nothing. ``__init__.pyi`` lists them.
`render` and `views` are rooms of the package, hence `render_views` and `draw_sheet`.
"""

from lazy_loader import attach_stub

from flexgs_edge._version import __version__ as __version__

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
