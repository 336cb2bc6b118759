"""Views of a scene, statistics over views, and figures of image quality."""

from flexgs_edge.render.device_scene import DeviceScene, sum_bytes
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.render.statistics import Statistics

__all__ = ["DeviceScene", "Renderer", "Statistics", "sum_bytes"]
