"""What lies beside a scene. Apart from `inputs`: `info` starts without the coder."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

from flexgs_edge.cameras import find_cameras
from flexgs_edge.scene import Companions, find_companions

LOG = logging.getLogger("flexgs_edge")


def companions_of(path: str | Path) -> Companions:
    """What lies beside the scene at `path`; logged, so that nobody wonders where cameras came from."""
    found = find_companions(path)
    if found.cameras is None:
        folder = Path(path) if Path(path).is_dir() else Path(path).parent
        found = replace(found, cameras=find_cameras(folder))
    for what, place in (("cameras", found.cameras), ("photos", found.images)):
        if place is not None:
            LOG.info("found %s beside the scene: %s", what, place)
    return found
