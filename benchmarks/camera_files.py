"""Writes camera files."""

from __future__ import annotations

import json
from collections.abc import Sequence

from flexgs_edge.cameras.camera import Camera


def inria_json(cameras: Sequence[Camera]) -> str:
    """The text of INRIA's cameras.json, one camera a line; it has no place for principal points and distortion."""
    entries = [
        {
            "id": number,
            "img_name": camera.name,
            "width": camera.width,
            "height": camera.height,
            "position": camera.center.tolist(),
            "rotation": camera.rotation.T.tolist(),
            "fy": camera.fy,
            "fx": camera.fx,
        }
        for number, camera in enumerate(cameras)
    ]
    return "[\n" + ",\n".join(json.dumps(entry) for entry in entries) + "\n]\n"
