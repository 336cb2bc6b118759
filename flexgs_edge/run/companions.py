"""Find the cameras and photos beside a scene.

This is not part of `inputs`, so that `info` starts without importing the coder.
"""

from __future__ import annotations

import logging
import os
from dataclasses import replace
from pathlib import Path

from flexgs_edge.cameras.nerfstudio import dataparser_above
from flexgs_edge.cameras.read import NERF_SYNTHETIC, find_cameras
from flexgs_edge.io.model_folder import Companions, find_companions

LOG = logging.getLogger("flexgs_edge")


def companions_of(path: str | os.PathLike[str]) -> Companions:
    """Find cameras, photos and drawing settings beside the scene at `path`, and log the cameras and photos found."""
    found = find_companions(path)
    if found.cameras is None:
        folder = Path(path) if Path(path).is_dir() else Path(path).parent
        found = replace(found, cameras=find_cameras(folder))
        if found.images is None and found.cameras == folder / NERF_SYNTHETIC and (folder / "train").is_dir():
            found = replace(found, images=folder / "train")
    found = replace(found, dataparser=dataparser_above(Path(path)))
    for what, place in (("cameras", found.cameras), ("photos", found.images)):
        if place is not None:
            LOG.info("found %s beside the scene: %s", what, place)
    return found


def merge_companions(first: Companions, second: Companions) -> Companions:
    """Combine the companions of two scenes.

    Cameras and photos both come from `first` if it has cameras, else from `second`: photos of another place would not match.
    Background and antialiasing come from whichever scene states them, `first` before `second`.
    """
    chosen = first if first.cameras is not None else second
    white = first.white_background if first.white_background is not None else second.white_background
    antialiased = first.antialiased if first.antialiased is not None else second.antialiased
    return Companions(chosen.cameras, chosen.images, white, antialiased, chosen.dataparser)
