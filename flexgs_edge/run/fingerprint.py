"""A digest of scene, poses and drawing: the same exactly where scores would be."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np

from flexgs_edge._version import __version__
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.scene.source import SceneSource

ROWS = 1 << 16
"""Rows of the scene hashed at a time."""
FIELDS = ("means", "log_scales", "quats", "opacity_logits")
"""What hits, weights and volumes depend on; colours change none of them."""


def fingerprint(
    source: SceneSource,
    cameras: Sequence[Camera],
    kind: str,
    near: float,
    extent: str,
    antialiased: bool = False,
    fields: Sequence[str] = FIELDS,
) -> str:
    """A digest of everything that scores depend on; reads the scene once, by default without its colours.

    Parameters
    ----------
    source : SceneSource
        The scene as it is scored: rows left out are not part of it.
    cameras : sequence of Camera
        The training poses, at the size they are drawn. Their names do not count.
    kind, near, extent, antialiased : str, float, str, bool
        Which score, and how views are drawn.
    fields : sequence of str
        What the score depends on.
    """
    digest = hashlib.sha256(
        f"{__version__} {kind} {near!r} {extent} {antialiased} {source.count} {len(cameras)}".encode()
    )
    digest.update(source.origin.astype("<f8").tobytes())
    for camera in cameras:
        numbers = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        for values in (numbers, camera.rotation, camera.translation):
            digest.update(np.asarray(values, "<f8").tobytes())
    for rows in source.chunks(ROWS):
        for plane in source.read(rows, fields).values():
            digest.update(np.ascontiguousarray(plane, "<f4").data)
    return digest.hexdigest()
