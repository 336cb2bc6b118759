"""How far from all others each Gaussian lies, measured by what is usual in the scene."""

import numpy as np

from flexgs_edge.scene.contraction import Contraction
from flexgs_edge.scene.curve import morton

NEIGHBOUR = 4  # A few floaters beside each other have their first neighbours in common
CURVES, WINDOW = 6, 8
"""Neighbours are looked for along so many Morton curves, among so many rows before and after. Curves that are moved by parts of a
cell have other rows side by side."""
BLOCK = 1 << 16  # Rows whose neighbours are looked for at a time
DEVIATION = 1.4826  # Standard deviation of a normal distribution over its median absolute deviation
UNITS = 2.0**16  # Logarithms are whole numbers of 1 / UNITS, so that machines agree on them
_STEPS = np.sqrt([[2.0], [3.0], [5.0]])  # Irrational, so that no cell has its walls twice at one place


def usual_deviation(values: np.ndarray) -> float:
    """Standard deviation of most values, which a few far ones hardly change; 0 for no values."""
    return DEVIATION * float(np.median(np.abs(values - np.median(values)))) if len(values) else 0.0


def _standard(values: np.ndarray) -> np.ndarray:
    """Values by how many usual deviations they lie above the median; zeros where most are alike."""
    usual = usual_deviation(values)
    return (values - np.median(values)) / usual if usual > 0 else np.zeros(len(values))


def isolation(means: np.ndarray, log_scales: np.ndarray) -> np.ndarray:
    """How isolated each Gaussian is: [N] f64, in standard deviations of the scene.

    It is the log of the distance to the fourth neighbour, added to the log of this distance over the Gaussian's own largest
    deviation. Each of both counts in its usual deviations: far Gaussians are sparse and large, floaters are sparse and small.

    `means`, `log_scales`: [3, N].
    """
    if means.shape[1] <= NEIGHBOUR:
        return np.zeros(means.shape[1])
    distance = np.rint(np.log(np.maximum(_neighbour_distances(means), 1e-300)) * UNITS) / UNITS
    isolated: np.ndarray = _standard(distance) + _standard(distance - log_scales.max(axis=0))
    return isolated


def _neighbour_distances(means: np.ndarray) -> np.ndarray:
    """[N] f64, distance to the neighbour of number `NEIGHBOUR`, or a little more where the curves miss a neighbour."""
    places = means.astype(np.float64)
    centre = np.median(places, axis=1, keepdims=True)
    radius = float(np.median(np.abs(places - centre), axis=1).max())
    x, y, z = centre[:, 0].tolist()
    # Far out, cells would be too coarse for what lies near, or too many.
    spread = Contraction((x, y, z), radius or 1.0).contract(places) - centre
    spread *= 0.25 / max(float(np.abs(spread).max()), 1e-300)
    nearest = np.full((NEIGHBOUR, places.shape[1]), np.inf)
    for curve in range(CURVES):
        order = np.argsort(
            morton(((spread + 0.25 + 0.5 * (_STEPS * curve % 1)) * (2**21 - 1)).astype(np.int64)), kind="stable"
        )
        for start in range(0, len(order), BLOCK):
            first = max(start - WINDOW, 0)
            rows = order[first : start + BLOCK + WINDOW]
            own = slice(start - first, start - first + BLOCK)
            near = np.sort(_along(places[:, rows])[:, own], axis=0)[:NEIGHBOUR]
            nearest[:, rows[own]] = np.minimum(nearest[:, rows[own]], near)
    distance: np.ndarray = np.sqrt(nearest[-1])
    return distance


def _along(places: np.ndarray) -> np.ndarray:
    """Squared distances of each place to those up to `WINDOW` before and after it."""
    found = np.full((2 * WINDOW, places.shape[1]), np.inf)
    for step in range(1, min(WINDOW, places.shape[1] - 1) + 1):
        found[2 * step - 1, step:] = np.square(places[:, step:] - places[:, :-step]).sum(axis=0)
        found[2 * step - 2, :-step] = found[2 * step - 1, step:]
    return found
