"""Place cameras automatically around a scene that has none, so that the Gaussians are seen as in training.

Two things in a trained scene tell where its cameras stood. SH above degree 0 start at zero and grow only along
directions that cameras looked from. So view-dependent colour is strong towards the training cameras, and fades
elsewhere. And cameras stood in the open, with matter in sight. Candidates form a lattice in and around the scene. A
coarse grid of optical depth removes those in opaque matter. Then we pick views one by one for what they add. Objects
get rings outside, and surroundings get views inside out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.witnesses import SKIN, Gaussians, Witnesses, gather_witnesses
from flexgs_edge.errors import InputError

DEFAULT_VIEWS = 48
DEFAULT_SIZE = (640, 480)
FIELD_OF_VIEW = math.radians(50.0)
"""Angle of view across the image's width; lenses of phones, and those usual in the field, have 40 to 70 degrees."""
LATTICE = 16
"""Candidates along the longest side of the lattice."""
MARGIN = 1.2
"""The lattice reaches so many half sides of the middle box to each side."""
POSITIONS = 400
"""Number of best candidates from which views are made."""
SHOWN_SHARE = {True: 0.5, False: 0.65}
"""Places that show less than this share of the best place, in all directions together, are left out. Inside a room one
sees all walls, from outside only half of them. If SH tell directions (True), they tell this too."""
QUICK = 5
"""Every 5th witness judges all candidates, and all witnesses judge the better ones: faster, with the same views."""
DIRECTIONS = 192
OPEN_DEPTH = 0.25
"""Largest optical depth of a cell, along its side, in which a camera may stand."""
NEAR_SHARE = 0.15
"""The part of a view nearer than this share of the extent should be almost empty."""
NEAR_CLEAR = 0.7
"""Share of light that must get through that near part, in the mean over the view."""
SHARP = 0.008
"""Usual deviation of a splat over its distance from a camera (5 pixels in a view 640 wide)."""
SHARP_SPREAD = math.log(8.0)
"""One standard deviation of its logarithm. It is wide, since scenes of few large splats are seen from the same
distance."""
AGREEMENT_POWER = 3.0
SEEN_POWER = 1.5
"""A witness that n views show as well as the best place counts (1 + n)^-SEEN_POWER."""
APART = 0.2
"""Views nearer to each other than this share of the extent add less."""
LEVEL = 0.2
"""Views do not tell which way is up if their mean direction is within this of level."""


def automatic_rig(
    source: Gaussians, views: int = DEFAULT_VIEWS, width: int = DEFAULT_SIZE[0], height: int = DEFAULT_SIZE[1]
) -> tuple[list[Camera], str]:
    """Place cameras for a scene that has none; the same scene always gets the same cameras.

    Parameters
    ----------
    source : SceneSource
        Checked: finite and not empty.
    views : int, optional
        Number of cameras, named auto_000, auto_001, ... in order of what they add, so that every hold-out is a mixture.
    width, height : int, optional
        Pixels.

    Returns
    -------
    cameras : list of Camera
        World coordinates.
    note : str
        How the cameras were placed, for the summary.

    Raises
    ------
    InputError
        If less than one view is asked for, or the scene has no extent.
    """
    if views < 1:
        raise InputError(f"{views} automatic views: expected at least 1")
    scene = gather_witnesses(source)
    focal = width / 2 / math.tan(FIELD_OF_VIEW / 2)
    places = open_places(scene)
    for part, kept in ((scene.thinned(QUICK), 2 * POSITIONS), (scene, POSITIONS)):
        merit, shown = _merit(part, places)
        least = SHOWN_SHARE[bool(scene.tells.any())] * shown.max()
        rank = np.where(shown >= least, merit.sum(axis=1), 0.0)
        best = np.argsort(-rank, kind="stable")[: min(kept, int((rank > 0).sum()) or 1)]
        places, merit = places[best], merit[best]
    # A circle of the frame's area. What it misses in the corners and adds beside the frame evens out.
    frame = _Frame(fibonacci(DIRECTIONS), math.atan(math.sqrt(width * height / math.pi) / focal))
    chosen = _choose(scene, places, merit, frame, views)
    directions = frame.directions
    up, name = up_axis(places[[p for p, _ in chosen]], directions[[d for _, d in chosen]])
    cameras = [
        look(f"auto_{index:03d}", places[p] + source.origin, directions[d], up, width, height, focal)
        for index, (p, d) in enumerate(chosen)
    ]
    return cameras, _note(scene, places[[p for p, _ in chosen]], name)


def open_places(scene: Witnesses) -> np.ndarray:
    """[n, 3] f64, candidates on a lattice in and around the scene, without those in opaque matter."""
    reach = (1 + MARGIN) * np.maximum(scene.half, 0.5 * scene.half.max())
    step = 2 * float(reach.max()) / LATTICE
    axes = [np.arange(-math.floor(r / step), math.floor(r / step) + 1) * step for r in reach]
    lattice = np.stack(np.meshgrid(*axes, indexing="ij")).reshape(3, -1) + scene.middle[:, None]
    offsets = np.stack(np.meshgrid(*[np.array([-1.0, 0.0, 1.0])] * 3, indexing="ij")).reshape(3, -1) * scene.cell
    worst = np.zeros(lattice.shape[1])
    for offset in offsets.T:
        worst = np.maximum(worst, scene.optical_depth(lattice + offset[:, None]))
    # If there is thin fog everywhere, the clearest quarter is the best there is.
    limit = max(OPEN_DEPTH, float(np.quantile(worst, 0.25)))
    return np.ascontiguousarray(lattice[:, worst <= limit].T)


def _merit(scene: Witnesses, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How well each place shows each witness ([n, M] f64), and how much of the scene a place should show ([n] f64)."""
    merit = np.empty((len(places), scene.weights.size))
    shown = np.empty(len(places))
    for row, place in enumerate(places):
        distance = np.linalg.norm(scene.means - place[:, None], axis=0)
        angles = scene.sizes / np.maximum(distance, 1e-6 * scene.extent)
        sharp = np.exp(-0.5 * (np.log(np.maximum(angles, 1e-30) / SHARP) / SHARP_SPREAD) ** 2)
        agreement = scene.agreement(place) ** AGREEMENT_POWER
        visible = scene.weights * scene.transmittance(place, scene.means) * agreement
        merit[row], shown[row] = visible * sharp, visible.sum()
    return merit, shown


@dataclass(frozen=True)
class _Frame:
    """Directions of view ([D, 3]), and the half angle of a view."""

    directions: np.ndarray
    cone: float

    def shows(self, place: np.ndarray, points: np.ndarray) -> np.ndarray:
        """[D, n] bool, the `points` ([3, n]) that each view from `place` shows."""
        lines = points - place[:, None]
        lines /= np.maximum(np.linalg.norm(lines, axis=0), 1e-12)
        # einsum instead of @: these products are too small for BLAS, whose threads are far slower on a busy machine.
        inside: np.ndarray = np.einsum("dx,xn->dn", self.directions, lines) > math.cos(self.cone)
        return inside

    def clear(self, scene: Witnesses, place: np.ndarray) -> np.ndarray:
        """[D] bool, the directions in which almost nothing is near."""
        ahead = self.directions.T * (NEAR_SHARE * scene.extent + SKIN * scene.cell)
        through = scene.transmittance(place, place[:, None] + ahead)
        around = np.einsum("dx,ex->de", self.directions, self.directions) > math.cos(self.cone)
        clear: np.ndarray = np.einsum("de,e->d", around, through) >= NEAR_CLEAR * around.sum(axis=1)
        return clear


def _choose(
    scene: Witnesses, places: np.ndarray, merit: np.ndarray, frame: _Frame, views: int
) -> list[tuple[int, int]]:
    """(place, direction) of each view; each next view is the one that adds most."""
    # If no place is clear, the best of the others is taken.
    clear = [np.where(frame.clear(scene, place), 1.0, 1e-6) for place in places]
    seen, room = np.zeros(merit.shape[1]), np.ones(len(places))
    fullest = np.maximum(merit.max(axis=0), 1e-300)
    # The gain of a view only falls, so an older gain is an upper bound. Few places are looked at again for each view.
    bounds, directions = np.full(len(places), np.inf), np.zeros(len(places), np.int64)
    chosen: list[tuple[int, int]] = []
    for _ in range(views):
        wanted = (1 + seen) ** -SEEN_POWER
        fresh = np.zeros(len(places), bool)
        while not fresh[best := int(np.argmax(bounds))]:
            gains = np.einsum("dm,m->d", frame.shows(places[best], scene.means), merit[best] * wanted)
            gains *= clear[best] * room[best]
            directions[best], bounds[best], fresh[best] = np.argmax(gains), gains.max(), True
        chosen.append((best, int(directions[best])))
        seen += frame.shows(places[best], scene.means)[directions[best]] * (merit[best] / fullest)
        distance = np.linalg.norm(places - places[best], axis=1) / (APART * scene.extent)
        room *= 1 - 0.7 * np.exp(-0.5 * distance**2)
    return chosen


def up_axis(places: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, str]:
    """The direction of up ([3] f64, a coordinate axis), and its name.

    People walk around a scene more than they climb, and look down on it more than up. So up is y or z, whichever the
    places ([n, 3]) and directions ([n, 3]) vary least along, and it points against the mean direction. If views are
    level, up is -y or +z, by the conventions of COLMAP and NeRF.
    """
    mean = directions.mean(axis=0)
    spread = places.std(axis=0) / max(float(places.std()), 1e-300) + 2 * mean * mean
    axis = 1 if spread[1] < spread[2] else 2
    sign = -np.sign(mean[axis]) if abs(mean[axis]) > LEVEL else (-1.0 if axis == 1 else 1.0)
    up = np.zeros(3)
    up[axis] = sign
    return up, f"{'+' if sign > 0 else '-'}{'xyz'[axis]}"


def look(
    name: str, position: np.ndarray, direction: np.ndarray, up: np.ndarray, width: int, height: int, focal: float
) -> Camera:
    """A camera at `position` that looks along `direction`; the top of the image points to `up` (all [3], world)."""
    forward = direction / np.linalg.norm(direction)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-3:  # straight up or down: any roll will do
        right = np.cross(forward, np.roll(up, 1))
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Camera(name, width, height, rotation, -rotation @ position, focal, focal, (width - 1) / 2, (height - 1) / 2)


def fibonacci(count: int) -> np.ndarray:
    """[count, 3] f64, unit vectors spread evenly over all directions."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.arange(count) * math.pi * (3 - math.sqrt(5))
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def _note(scene: Witnesses, places: np.ndarray, up: str) -> str:
    inside = float(np.mean(np.all(np.abs(places - scene.middle) < scene.half, axis=1)))
    kind = "inside out" if inside > 0.75 else "from outside" if inside < 0.25 else "from inside and outside"
    told = "where SH are strongest" if scene.tells.any() else "by what is in sight (no SH tell where cameras stood)"
    return f"{len(places)} automatic views {kind}, placed {told}; up is taken to be {up}"
