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
    bits : tuple of int
        Bits a value for plain rounding.
    coarser : tuple of float
        Factors on the step sizes that best chose.
    group_rows : tuple of int
        Rows that share a range; 0 means all rows.
    outliers : tuple of float
        Stray values, in standard deviations of their channel.
    pruned : tuple of int
        Shares of Gaussians that are removed, or that lose their SH, in thousandths.
    distances : tuple of float
        Factors on the distance from a camera to the scene.
    poses : int
        How many held-out views other poses are made from.
    moves : tuple of str
        Names of `moves.MOVES`.
    few : int
        Poses that runs of best on moved scenes score. With very few, refits differ from run to run.
    few_width : int
        Most pixels that the views of these poses are wide.
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
    bits: tuple[int, ...] = (8, 7, 6, 5, 4, 3, 2)
    coarser: tuple[float, ...] = (1.0, 2.0, 4.0, 8.0, 16.0)
    group_rows: tuple[int, ...] = (16, 64, 512, 4096, 32768, 0)
    outliers: tuple[float, ...] = (0.0, 1e3, 1e6)
    pruned: tuple[int, ...] = (100, 300, 500, 700, 800, 900, 950)
    distances: tuple[float, ...] = (0.25, 0.5, 0.71, 1.0, 1.41, 2.0, 4.0)
    poses: int = 4
    moves: tuple[str, ...] = (
        "moved 1e3, float32", "moved 1e3, float64", "moved 1e5, float64", "moved 1e6, float64", "scaled 1e-4",
        "scaled 1e-3", "scaled 1e3", "scaled 1e4", "turned",
    )  # fmt: skip
    few: int = 12
    few_width: int = 320
    generations: int = 5
    fewest: int = 1
    halves: bool = True
    even: bool = True


FULL = Amounts()
QUICK = Amounts(
    width=120,
    bits=(8, 4, 2),
    coarser=(1.0, 4.0),
    group_rows=(64, 0),
    outliers=(0.0, 1e6),
    pruned=(300, 700, 950),
    distances=(0.5, 1.0, 2.0),
    poses=2,
    moves=("moved 1e3, float32",),
    few=6,
    few_width=120,
    generations=2,
    fewest=16,
    halves=False,
    even=False,
)
"""A quick look at every experiment, for tests."""
