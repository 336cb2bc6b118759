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
    from flexgs_edge.cameras.camera import Camera
    from flexgs_edge.cameras.read import read_cameras
    from flexgs_edge.commands.compress import compress
    from flexgs_edge.commands.decompress import decompress
    from flexgs_edge.commands.evaluate import evaluate
    from flexgs_edge.commands.info import info
    from flexgs_edge.commands.render import render_views
    from flexgs_edge.commands.score import score_gaussians
    from flexgs_edge.commands.synth import synth
    from flexgs_edge.commands.trim import trim
    from flexgs_edge.commands.verify import verify
    from flexgs_edge.commands.worth import worth
    from flexgs_edge.errors import BudgetError, DeviceError, FlexGSError, FormatError, InputError, TargetError
    from flexgs_edge.io.ply import write_ply
    from flexgs_edge.kernels.choose_device import list_devices
    from flexgs_edge.progress import Progress
    from flexgs_edge.run.inputs import read_scene
    from flexgs_edge.run.options import CompressOptions, ViewOptions
    from flexgs_edge.scene.source import SceneSource

_HOMES = {
    "compress": "commands.compress",
    "decompress": "commands.decompress",
    "render_views": "commands.render",
    "evaluate": "commands.evaluate",
    "score_gaussians": "commands.score",
    "info": "commands.info",
    "verify": "commands.verify",
    "trim": "commands.trim",
    "synth": "commands.synth",
    "worth": "commands.worth",
    "list_devices": "kernels.choose_device",
    "read_scene": "run.inputs",
    "read_cameras": "cameras.read",
    "write_ply": "io.ply",
    "CompressOptions": "run.options",
    "ViewOptions": "run.options",
    "Camera": "cameras.camera",
    "Progress": "progress",
    "SceneSource": "scene.source",
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
