"""The points of every experiment of `study stability`: all of them, or a few for a quick look."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Amounts:
    """The points of every experiment.

    Parameters
    ----------
    width : int or None
        Most pixels that views are wide. None (default): as `--resolution` says.
    pruned : tuple of int
        Shares of Gaussians that are removed, or that lose their SH, in thousandths.
    distances : tuple of float
        Factors on the distance from a camera to the scene.
    poses : int
        How many held-out views other poses are made from.
    generations : int
        How often the scene is compressed, each time from the file before.
    fewest : int
        Least views to score from. Each next number is twice as large.
    halves : bool
        Also score from one half of the poses and judge on the other.
    even : bool
        Also let the even held-out views decide, and judge on the odd ones.
    """

    width: int | None = None
    pruned: tuple[int, ...] = (100, 300, 500, 700, 800, 900, 950)
    distances: tuple[float, ...] = (0.25, 0.5, 0.71, 1.0, 1.41, 2.0, 4.0)
    poses: int = 4
    generations: int = 5
    fewest: int = 1
    halves: bool = True
    even: bool = True


FULL = Amounts()
QUICK = Amounts(
    width=120,
    pruned=(300, 700, 950),
    distances=(0.5, 1.0, 2.0),
    poses=2,
    generations=2,
    fewest=16,
    halves=False,
    even=False,
)
"""A quick look at every experiment, for tests."""
