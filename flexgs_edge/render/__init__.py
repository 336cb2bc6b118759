"""Views of a scene, statistics over views, and figures of image quality."""

from flexgs_edge.render.device_scene import DeviceScene, sum_bytes
from flexgs_edge.render.records import Statistics
from flexgs_edge.render.renderer import Renderer

__all__ = ["DeviceScene", "Renderer", "Statistics", "sum_bytes"]
