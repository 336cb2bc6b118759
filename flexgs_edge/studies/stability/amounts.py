"""How much of every experiment of `study stability` is measured: whole, or quickly."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Amounts:
    """The points of every experiment.

    Parameters
    ----------
    width : int or None
        Views are at most so wide; None leaves that to `--resolution`.
    bits : tuple of int
        Bits a value of plain rounding.
    coarser : tuple of float
        Factors of the grid steps that best chose.
    group_rows : tuple of int
        Rows that share a range; 0 is all of them.
    outliers : tuple of float
        Stray values, in spreads of their channel.
    pruned : tuple of int
        Gaussians removed, or their SH, in thousandths.
    distances : tuple of float
        Of a camera to what it looks at, as factors.
    poses : int
        Held-out views that other poses are made of.
    moves : tuple of str
        Names of `moves.MOVES`.
    few : int
        Poses that runs of the measured method on moved scenes score: with 8, refits of the sample scene differed by up to 0.7 dB.
    few_width : int
        Pixels that their views are wide, at most.
    generations : int
        Rounds of compressing, decompressing and compressing again.
    fewest : int
        Views that scores are first taken from; each next number is twice that.
    halves : bool
        Score one half of the poses, judge on the other.
    even : bool
        Stop by the even held-out views, judge on the odd ones.
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
"""A look at every experiment, for tests: 90 seconds for a scene of 33 000 Gaussians on two cores."""
