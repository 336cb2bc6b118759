"""Where cameras stood: a plan seen from above and one from the side, as inline SVG."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from flexgs_edge.report.html import text
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

STYLE = """
.plans { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 19rem), 1fr)); gap: 1rem;
  align-items: start; }
.plans figure { margin: 0; }
.plan { display: block; width: 100%; background: var(--band); border-radius: 6px; font-size: 12px; font-weight: 600; }
.plan .points { fill: none; stroke: var(--soft); stroke-width: 1.4; stroke-linecap: round; opacity: .65; }
.plan .wedge { fill: var(--mark); fill-opacity: .1; stroke: var(--mark); stroke-opacity: .55; stroke-width: .7; }
.plan .stand { fill: var(--mark); }
.plan .held { fill: var(--warm); stroke: var(--warm); } .plan .held.wedge { fill-opacity: .2; }
.plan text { fill: var(--ink); paint-order: stroke; stroke: var(--band); stroke-width: 3px; }
"""


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
    top = _plan("seen from above", rig, numbers, (across, away), (low[[0, 1]], high[[0, 1]]), scale, 0)
    side = _plan("seen from the side", rig, numbers, (across, up), (low[[0, 2]], high[[0, 2]]), scale, 1)
    held = len(rig.held_out)
    key = f"{len(rig.names) - held} training" + (f", {held} held out" if held else "")
    marks = _mark("stand") + f" training &ensp;{_mark('stand held')} held out &ensp;" if held else ""
    scene = "dots: the scene; " if len(rig.points) else ""
    return (
        f'<div class="plans">{top}{side}</div>\n<p class="key">{marks}'
        f"{key} views; {scene}wedges: where cameras look; numbers: the pictures above. Up is what the cameras call up, on "
        "average.</p>"
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
    numbers: Mapping[str, int],
    basis: tuple[np.ndarray, np.ndarray],
    ends: tuple[np.ndarray, np.ndarray],
    scale: float,
    half: int,
) -> str:
    """One plan; `half`: which half angle (0 width, 1 height) the wedges open by."""
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
    words = f"Plan of {len(rig.names)} cameras, {title}"
    parts = [f'<svg class="plan" viewBox="0 0 {SIDE} {height:.0f}" role="img" aria-label="{text(words)}">']
    parts.append(_points(at(rig.points) if len(rig.points) else np.zeros((0, 2)), height))
    # Held-out cameras last: they are few and shall not be covered.
    order = sorted(range(len(rig.names)), key=lambda i: (i in rig.held_out, i))
    for i in order:
        kind = " held" if i in rig.held_out else ""
        a, b, c = (f"{p[0]:.1f} {p[1]:.1f}" for p in (feet[i], left[i], right[i]))
        name = f"<title>{text(rig.names[i])}</title>" if len(order) <= MOST_NAMES else ""
        parts.append(f'<path class="wedge{kind}" d="M{a}L{b}L{c}Z"/>')
        parts.append(f'<circle class="stand{kind}" cx="{feet[i][0]:.1f}" cy="{feet[i][1]:.1f}" r="2.4">{name}</circle>')
    for i in order:
        if rig.names[i] in numbers:
            x, y = np.clip(feet[i] + (5, -5), (2, 12), (SIDE - 12, height - 4))
            parts.append(f'<text x="{x:.1f}" y="{y:.1f}">{numbers[rig.names[i]]}</text>')
    return "\n".join(["<figure>", *parts, f"</svg><figcaption>{title}</figcaption></figure>"])


def _points(points: np.ndarray, height: float) -> str:
    inside = points[((points >= 0) & (points <= (SIDE, height))).all(axis=1)]
    if not len(inside):
        return ""
    return '<path class="points" d="' + "".join(_dots(inside)) + '"/>'


def _dots(points: np.ndarray) -> Iterable[str]:
    return (f"M{x:.0f} {y:.0f}h0" for x, y in dict.fromkeys((round(x), round(y)) for x, y in points))


def _mark(kind: str) -> str:
    return (
        f'<svg class="plan" viewBox="0 0 16 16" aria-hidden="true"><circle class="{kind}" cx="8" cy="8" r="5"/></svg>'
    )
