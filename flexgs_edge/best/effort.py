"""How much work a search by measured costs spends: counted, never timed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexgs_edge.cameras import Camera

LEAST_VIEWS = 6
"""Poses a step of the refit at the least: steps after 3 poses each fitted fox's 24 scored ones ever better and all others ever
worse."""

PIXELS_A_ROW = 24
"""Pixels of all scored poses for each Gaussian at the least. Bytes at 1 dB and processor seconds (balanced): fox at every pixel
(131 pixels a row) 557 kB, 123 s; at every second of both directions (33) 546 kB, 75 s; every third (15) 8 % more bytes. The
sample at every second (92) and third (41): 121 and 119 kB."""
LARGEST_STEP = 4
"""Most pixels from one to the next: splats of one or two pixels must not fall between them in every view."""


@dataclass(frozen=True)
class Effort:
    """How much work a search spends; fixed counts.

    Parameters
    ----------
    keep : float
        Share of the Gaussians that stays in each round of the path.
    refit_rounds : int
        Rounds on all coefficients before SH are put on their grid (one on the constant follows).
    subsets : int
        Steps a round at most, as for `refit_colours`.
    steps : int
        Whole results that are measured, at most while something holds.
    close : float
        Excess (log of loss over limit) that ends the search when it is no farther below the target: 0.03 are about 1.5 % of
        the bytes.
    views : int
        Most scored poses.
    passes : float
        Times that the descent to the first whole result looks at every scored pose; 0: colours are refitted instead.
    """

    keep: float
    refit_rounds: int
    subsets: int
    steps: int
    close: float
    views: int
    passes: float = 0.0

    def subsets_of(self, poses: int) -> int:
        """Steps a round for so many scored poses."""
        return max(min(self.subsets, poses // LEAST_VIEWS), 1)


def sampled_poses(cameras: Sequence[Camera], count: int) -> list[Camera]:
    """The views at every pixel, or at a part of them where that is enough to measure `count` Gaussians.

    The part is the same lattice in every view, begun at another pixel from view to view in the order of their names: ties among
    poses, which rounding of a scene that was moved may break, decide no pixel.
    """
    step = 1
    while step < LARGEST_STEP and sum(_lattice(camera, step + 1) for camera in cameras) >= PIXELS_A_ROW * count:
        step += 1
    places = np.argsort(np.argsort([camera.name for camera in cameras], kind="stable"), kind="stable")
    return [
        camera.every(step, *divmod(int(place) % step**2, step)) for place, camera in zip(places, cameras, strict=True)
    ]


def _lattice(camera: Camera, step: int) -> int:
    """Pixels of `camera` at every `step`-th one."""
    return (camera.width // step) * (camera.height // step)


EFFORTS = {
    "fast": Effort(keep=0.8, refit_rounds=1, subsets=7, steps=1, close=0.08, views=48),
    "balanced": Effort(keep=0.88, refit_rounds=2, subsets=7, steps=2, close=0.05, views=96),
    "thorough": Effort(keep=0.9, refit_rounds=2, subsets=7, steps=5, close=0.02, views=400),
    "max": Effort(keep=0.8, refit_rounds=1, subsets=7, steps=2, close=0.05, views=96, passes=7.0),
}
