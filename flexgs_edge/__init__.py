"""NumPy + OpenCL toolkit that compresses trained 3D Gaussian splatting scenes.

The Python API has the words of the command line::

    import flexgs_edge

    result = flexgs_edge.compress("point_cloud.ply", "scene.fgs", max_drop=1.0)
    print(result.size, result.quality.drop)
    flexgs_edge.decompress("scene.fgs", "decoded.ply")

Names are imported when they are first used, so that ``import flexgs_edge`` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from flexgs_edge._version import __version__

if TYPE_CHECKING:
    from flexgs_edge.cameras import Camera, read_cameras
    from flexgs_edge.device.select import list_devices
    from flexgs_edge.errors import BudgetError, DeviceError, FlexGSError, FormatError, InputError, TargetError
    from flexgs_edge.pipeline.compress import compress
    from flexgs_edge.pipeline.contents import verify
    from flexgs_edge.pipeline.decompress import decompress
    from flexgs_edge.pipeline.evaluate import evaluate
    from flexgs_edge.pipeline.info import info
    from flexgs_edge.pipeline.inputs import read_scene
    from flexgs_edge.pipeline.options import CompressOptions, ViewOptions
    from flexgs_edge.pipeline.render import render_views
    from flexgs_edge.pipeline.score import score_gaussians
    from flexgs_edge.pipeline.synth import synth
    from flexgs_edge.pipeline.trim import trim
    from flexgs_edge.pipeline.worth import worth
    from flexgs_edge.progress import Progress
    from flexgs_edge.scene import SceneSource, write_ply

_HOMES = {
    "compress": "pipeline.compress",
    "decompress": "pipeline.decompress",
    "render_views": "pipeline.render",
    "evaluate": "pipeline.evaluate",
    "score_gaussians": "pipeline.score",
    "info": "pipeline.info",
    "verify": "pipeline.contents",
    "trim": "pipeline.trim",
    "synth": "pipeline.synth",
    "worth": "pipeline.worth",
    "list_devices": "device.select",
    "read_scene": "pipeline.inputs",
    "read_cameras": "cameras",
    "write_ply": "scene",
    "CompressOptions": "pipeline.options",
    "ViewOptions": "pipeline.options",
    "Camera": "cameras",
    "Progress": "progress",
    "SceneSource": "scene",
    "FlexGSError": "errors",
    "InputError": "errors",
    "FormatError": "errors",
    "TargetError": "errors",
    "DeviceError": "errors",
    "BudgetError": "errors",
}
"""Public names and their modules. `render` and `score` are rooms of the package, hence `render_views`, `score_gaussians`."""

__all__ = [
    "__version__",
    "compress",
    "decompress",
    "render_views",
    "evaluate",
    "score_gaussians",
    "info",
    "verify",
    "trim",
    "synth",
    "worth",
    "list_devices",
    "read_scene",
    "read_cameras",
    "write_ply",
    "CompressOptions",
    "ViewOptions",
    "Camera",
    "Progress",
    "SceneSource",
    "FlexGSError",
    "InputError",
    "FormatError",
    "TargetError",
    "DeviceError",
    "BudgetError",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'flexgs_edge' has no attribute {name!r}")
    value = getattr(import_module(f"flexgs_edge.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
