"""The points of every experiment of `study stability`: all of them, or a few for a quick look."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Amounts:
    """The points of every experiment."""

    width: int | None = None  # Most pixels that views are wide. None (default): as `--resolution` says.
    # Shares of Gaussians that are removed, or that lose their SH, in thousandths.
    pruned: tuple[int, ...] = (100, 300, 500, 700, 800, 900, 950)
    # Factors on the distance from a camera to the scene.
    distances: tuple[float, ...] = (0.25, 0.5, 0.71, 1.0, 1.41, 2.0, 4.0)
    poses: int = 4  # how many held-out views other poses are made from
    generations: int = 5  # how often the scene is compressed, each time from the file before
    fewest: int = 1  # Least views to score from. Each next number is twice as large.
    halves: bool = True  # also score from one half of the poses and judge on the other
    even: bool = True  # also let the even held-out views decide, and judge on the odd ones


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
