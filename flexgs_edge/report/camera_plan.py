"""Plans of the camera positions, from above and from the side, as inline SVG."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from flexgs_edge.report.html import render
from flexgs_edge.report.material import Rig

SIDE = 360
"""Width of a plan in its own units: as wide as a phone, like the charts."""
WEDGE = 0.055
"""Length of a camera's viewing wedge, as a share of the plan's width."""
ROOM = 0.06
"""Empty margin, as a share of the plan's width."""
FAR = 0.35
"""The scene's points widen the plan by at most this share of the cameras' extent. Some scenes reach to the horizon."""
MOST_NAMES = 400
"""With more cameras than this, plans leave out the names that a pointer would show, so that pages stay small."""


def plans(rig: Rig, numbers: Mapping[str, int]) -> str:
    """Draw both plans and their key."""
    across, away, up = axes(rig)
    low, high = extent(rig, np.stack([across, away, up]))
    # Both plans use one scale, so that they can be compared.
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
    """Unit vectors [3] of the plan's axes in the world: across, away and up.

    Away points from the viewer of the side plan into the scene. Up is the mean up direction of the cameras. If those cancel
    out, up is the direction in which camera positions vary least.
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
        # All cameras stand in one place: use right or forward of the first camera, whichever is less parallel to up.
        right, forward = rig.rotations[0, 0], rig.rotations[0, 2]
        across = max((axis - (axis @ up) * up for axis in (right, forward)), key=lambda axis: float(axis @ axis))
    across = across / np.linalg.norm(across)
    if across[np.argmax(np.abs(across))] < 0:
        across = -across
    return across, np.cross(up, across), up


def extent(rig: Rig, basis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ends [3] of the plan along the rows of `basis`: all cameras, and the middle of the scene as far as `FAR` allows."""
    places = rig.centers @ basis.T
    low, high = places.min(axis=0), places.max(axis=0)
    if len(rig.points):
        inner = np.percentile(rig.points @ basis.T, (5, 95), axis=0)
        size = float((high - low).max())
        reach = FAR * size if size > 0 else np.inf
        low = np.minimum(low, np.maximum(inner[0], low - reach))
        high = np.maximum(high, np.minimum(inner[1], high + reach))
    # A single camera without a scene has no extent: add a margin.
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
    """Compute the positions of one plan. `half` chooses the half angle of the wedges: 0 of the width, 1 of the height."""
    rows = np.stack(basis)
    low, high = ends
    rim = ROOM * SIDE
    size = float(scale * (high - low)[1])
    height = min(max(size + 2 * rim, SIDE / 4), SIDE)
    # Centre the plan: the extent does not fill its shorter side.
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
    # Draw the held-out cameras last: they are few and must stay visible.
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
    """Round points to whole positions within the plan, each once."""
    inside = points[((points >= 0) & (points <= (SIDE, height))).all(axis=1)]
    return list(dict.fromkeys((round(x), round(y)) for x, y in inside))
