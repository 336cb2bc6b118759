"""Where cameras stood: a plan seen from above and one from the side, as inline SVG."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from flexgs_edge.report.html import render
from flexgs_edge.report.material import Rig

SIDE = 360
"""Width of a plan in its own units: a phone's, as for charts."""
WEDGE = 0.055
"""Length of the wedge that shows where a camera looks, as a share of the plan."""
ROOM = 0.06
"""Empty rim, as a share of the plan."""
FAR = 0.35
"""The scene's points widen the plan by at most so many times the cameras' own extent: some scenes reach to the horizon."""
MOST_NAMES = 400
"""With more cameras their names (seen under a pointer) are left out: a page is not a list."""


def plans(rig: Rig, numbers: Mapping[str, int]) -> str:
    """Both plans with their key.

    Parameters
    ----------
    numbers : mapping
        Number by name of the views whose pictures are shown.
    """
    across, away, up = axes(rig)
    low, high = extent(rig, np.stack([across, away, up]))
    # One scale for both, so that they can be compared.
    scale = SIDE * (1 - 2 * ROOM) / max(float((high - low)[:2].max()), 1e-12)
    return render(
        "plans.html",
        plans=[
            _plan("seen from above", rig, (across, away), (low[[0, 1]], high[[0, 1]]), scale, 0),
            _plan("seen from the side", rig, (across, up), (low[[0, 2]], high[[0, 2]]), scale, 1),
        ],
        width=SIDE,
        numbers=numbers,
        named=len(rig.names) <= MOST_NAMES,
        training=len(rig.names) - len(rig.held_out),
        held_out=len(rig.held_out),
        points=len(rig.points),
    )


def axes(rig: Rig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vectors [3] of a plan's axes in the world: across, away (from the one who looks from the side) and up.

    Up is the mean of the cameras' own; where they cancel out, the direction in which cameras differ least.
    """
    centred = rig.centers - rig.centers.mean(axis=0)
    up = -rig.rotations[:, 1, :].mean(axis=0)
    if np.linalg.norm(up) < 0.1:
        up = np.linalg.svd(centred, full_matrices=True)[2][2]
    up = up / np.linalg.norm(up)
    flat = centred - np.outer(centred @ up, up)
    across = np.linalg.svd(flat, full_matrices=True)[2][0]
    across = across - (across @ up) * up
    if np.linalg.norm(flat) < 1e-9 or np.linalg.norm(across) < 1e-6:
        # One place for all cameras: what the first calls right (its own up is not `up`, or it would have no right of its own).
        right, forward = rig.rotations[0, 0], rig.rotations[0, 2]
        across = max((axis - (axis @ up) * up for axis in (right, forward)), key=lambda axis: float(axis @ axis))
    across = across / np.linalg.norm(across)
    if across[np.argmax(np.abs(across))] < 0:
        across = -across
    return across, np.cross(up, across), up


def extent(rig: Rig, basis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ends [3] of the plan along the rows of `basis`: all cameras, and the scene's middle as far as it is not too large."""
    places = rig.centers @ basis.T
    low, high = places.min(axis=0), places.max(axis=0)
    if len(rig.points):
        inner = np.percentile(rig.points @ basis.T, (5, 95), axis=0)
        size = float((high - low).max())
        reach = FAR * size if size > 0 else np.inf
        low = np.minimum(low, np.maximum(inner[0], low - reach))
        high = np.maximum(high, np.minimum(inner[1], high + reach))
    # A lone camera without a scene: some room around it.
    if float((high - low).max()) == 0.0:
        low, high = low - 1.0, high + 1.0
    return low, high


def _plan(
    title: str,
    rig: Rig,
    basis: tuple[np.ndarray, np.ndarray],
    ends: tuple[np.ndarray, np.ndarray],
    scale: float,
    half: int,
) -> dict[str, Any]:
    """Places of one plan; `half`: which half angle (0 width, 1 height) the wedges open by."""
    rows = np.stack(basis)
    low, high = ends
    rim = ROOM * SIDE
    size = float(scale * (high - low)[1])
    height = min(max(size + 2 * rim, SIDE / 4), SIDE)
    # In the middle of the plan: the extent along its shorter side does not fill it.
    offset = np.array([(SIDE - scale * (high - low)[0]) / 2, (height - size) / 2])

    def at(points: np.ndarray) -> np.ndarray:
        flat: np.ndarray = (points @ rows.T - low) * scale + offset
        flat[:, 1] = height - flat[:, 1]
        return flat

    length = WEDGE * SIDE / scale
    forward, side = rig.rotations[:, 2, :], rig.rotations[:, half, :]
    reach = np.minimum(rig.reach[:, half], 1.5)[:, None]
    feet = at(rig.centers)
    left, right = (at(rig.centers + length * (forward + sign * reach * side)) for sign in (-1, 1))
    # Held-out cameras last: they are few and shall not be covered.
    order = sorted(range(len(rig.names)), key=lambda i: (i in rig.held_out, i))
    return {
        "title": title,
        "height": height,
        "dots": _dots(at(rig.points), height) if len(rig.points) else [],
        "stands": [
            {
                "name": rig.names[i],
                "held_out": i in rig.held_out,
                "foot": tuple(feet[i]),
                "left": tuple(left[i]),
                "right": tuple(right[i]),
                "label": np.clip(feet[i] + (5, -5), (2, 12), (SIDE - 12, height - 4)),
            }
            for i in order
        ],
    }


def _dots(points: np.ndarray, height: float) -> list[tuple[int, int]]:
    """Whole places within the plan, each once."""
    inside = points[((points >= 0) & (points <= (SIDE, height))).all(axis=1)]
    return list(dict.fromkeys((round(x), round(y)) for x, y in inside))
