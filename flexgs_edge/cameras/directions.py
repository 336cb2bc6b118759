"""Directions of view from a place, and sums over what lies within a frame around each."""

import math

import numpy as np

FACE = 16  # Bins along the side of each face of a cube of directions: 7 degrees or less each
BINS = 6 * FACE * FACE


def fibonacci(count: int) -> np.ndarray:
    """[count, 3] f64, unit vectors spread evenly over all directions."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.arange(count) * math.pi * (3 - math.sqrt(5))
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def bins_of(lines: np.ndarray) -> np.ndarray:
    """[...] int64, the bin of each direction ([3, ...], any length): one of 6 faces of a cube, and a square of it."""
    x, y, z = np.abs(lines)
    along_x, along_y = (x >= y) & (x >= z), y >= z
    x, y, z = lines
    # Several times as fast as `choose`.
    axis, major, first, second = (
        np.where(along_x, a, np.where(along_y, b, c)) for a, b, c in ((0, 1, 2), (x, y, z), (y, z, x), (z, x, y))
    )
    size = np.maximum(np.abs(major), 1e-300)
    row, column = (np.minimum((part / size + 1) * (FACE / 2), FACE - 1).astype(np.int64) for part in (first, second))
    return ((axis * 2 + (major < 0)) * FACE + row) * FACE + column


def filled_share(bins: np.ndarray) -> float:
    """Share of all directions, in parts of 4 x 4 bins, that hold some of `bins` ([n] int64)."""
    side = FACE // 4
    held = np.bincount(bins, minlength=BINS).reshape(6, side, 4, side, 4).any(axis=(2, 4))
    return float(held.mean())


class Frames:
    """Directions of view, and the bins that a frame around each holds.

    A frame is a circle of the image's area. What it misses in the corners and adds beside the image evens out.

    `count`: number of directions. `cone`: half angle of a frame, radians.
    """

    def __init__(self, count: int, cone: float) -> None:
        self.directions, self.limit = fibonacci(count), math.cos(cone)
        centres = _bin_centres()
        inside = np.zeros((count, BINS), bool)
        for row, (x, y, z) in enumerate(self.directions):
            inside[row] = x * centres[0] + y * centres[1] + z * centres[2] > self.limit
        # Rows of bins, filled up with the number of a bin that is always empty.
        widths = inside.sum(axis=1)
        self._bins = np.full((count, max(1, int(widths.max()))), BINS)
        self._bins[np.arange(self._bins.shape[1]) < widths[:, None]] = np.nonzero(inside)[1]

    def sums(self, bins: np.ndarray, amounts: np.ndarray) -> np.ndarray:
        """[D] f64, the sum of `amounts` ([n] f64) in the frame around each direction; `bins` is [n] int64."""
        total = np.bincount(bins, amounts, BINS + 1)
        return total[self._bins].sum(axis=1)

    def holds(self, direction: np.ndarray, lines: np.ndarray) -> np.ndarray:
        """[n] bool, the unit vectors ([3, n]) in the frame around a direction ([3])."""
        x, y, z = direction
        return x * lines[0] + y * lines[1] + z * lines[2] > self.limit


def _bin_centres() -> np.ndarray:
    """[3, BINS] f64, unit vectors to the middles of the bins."""
    centres = np.zeros((3, BINS))
    ticks = (np.arange(FACE) + 0.5) * (2 / FACE) - 1
    for face in range(6):
        axis = face // 2
        row, column = np.meshgrid(ticks, ticks, indexing="ij")
        part = slice(face * FACE * FACE, (face + 1) * FACE * FACE)
        for turn, values in enumerate(
            (np.full(FACE * FACE, 1.0 - 2 * (face % 2)), row.reshape(-1), column.reshape(-1))
        ):
            centres[(axis + turn) % 3, part] = values
    centres /= np.sqrt((centres * centres).sum(axis=0))
    return centres
