"""A digest of everything that scores depend on, to know whether kept scores still apply."""

import hashlib
from collections.abc import Sequence

import numpy as np

from flexgs_edge._version import __version__
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.scene.source import SceneSource

ROWS = 1 << 16  # We hash this many rows at a time
FIELDS = ("means", "log_scales", "quats", "opacity_logits")
"""Fields that change hits, weights or volumes. Colours change none of them."""


def fingerprint(
    source: SceneSource,  # the scene as it is scored, without rows that were left out
    cameras: Sequence[Camera],  # The training views, at the size they are drawn. Their names do not change the digest.
    kind: str,  # the score, such as `gs`
    near: float,
    antialiased: bool = False,
    fields: Sequence[str] = FIELDS,  # fields of the scene to hash
) -> str:
    """Hash everything that scores depend on. Reads the scene once, by default without its colours.

    `near`, `antialiased`: how views are drawn. Returns the digest in hexadecimal.
    """
    digest = hashlib.sha256(f"{__version__} {kind} {near!r} {antialiased} {source.count} {len(cameras)}".encode())
    digest.update(source.origin.astype("<f8").tobytes())
    for camera in cameras:
        numbers = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        for values in (numbers, camera.rotation, camera.translation):
            digest.update(np.asarray(values, "<f8").tobytes())
    for rows in source.chunks(ROWS):
        for plane in source.read(rows, fields).values():
            digest.update(np.ascontiguousarray(plane, "<f4").data)
    return digest.hexdigest()
