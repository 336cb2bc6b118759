"""Scenes: lazy sources, their readers and writers, and the checks before work starts."""

from flexgs_edge.scene.atomic import atomic_write, check_writable
from flexgs_edge.scene.check import check_scene
from flexgs_edge.scene.fields import FIELD, FIELDS, Field, sh_rest_count
from flexgs_edge.scene.model import Companions, find_companions, open_scene, register_reader
from flexgs_edge.scene.ply import PlySource, choose_origin, inria_dtype, write_ply
from flexgs_edge.scene.source import MemorySource, Planes, Rows, SceneSource, SelectSource

__all__ = [
    "FIELD",
    "FIELDS",
    "Companions",
    "Field",
    "MemorySource",
    "Planes",
    "PlySource",
    "Rows",
    "SceneSource",
    "SelectSource",
    "atomic_write",
    "check_scene",
    "check_writable",
    "choose_origin",
    "find_companions",
    "inria_dtype",
    "open_scene",
    "register_reader",
    "sh_rest_count",
    "write_ply",
]
