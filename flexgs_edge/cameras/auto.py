"""Place cameras automatically around a scene that has none, so that the Gaussians are seen as in training.

Two things in a trained scene tell where its cameras stood. SH above degree 0 start at zero and grow only along
directions that cameras looked from. So view-dependent colour is strong towards the training cameras, and fades
elsewhere. And cameras stood in the open, with matter in sight. Candidates form lattices in and around the scene and its
dense parts. A coarse grid of optical depth removes those in opaque matter. Then we pick views one by one for what they
add. Objects get rings outside, and surroundings get views inside out.

The same scene gets the same cameras on any machine. What exponentials and powers yield is rounded to whole numbers
before it is added or compared, and no sum depends on the order of its terms.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.directions import Frames, bins_of
from flexgs_edge.cameras.places import Places, open_places
from flexgs_edge.cameras.up import Stands, find_up, given_up
from flexgs_edge.cameras.witnesses import Gaussians, Witnesses, gather_witnesses
from flexgs_edge.errors import InputError

DEFAULT_VIEWS = 48
DEFAULT_SIZE = (640, 480)
FIELD_OF_VIEW = math.radians(65.0)
"""Angle of view across the image's width; lenses of phones, and those usual in the field, have 40 to 70 degrees. Wide
views show a thing together with its background: a method that scores only some of the views then scores both."""
POSITIONS = 400
"""Number of best candidates from which views are made."""
SHOWN_SHARE = {True: 0.5, False: 0.65}
"""Places that show less than this share of the best place, in all directions together, are left out. Inside a room one
sees all walls, from outside only half of them. If SH tell directions (True), they tell this too."""
QUICK = 8
"""Every 8th witness judges all candidates, and all witnesses judge the better ones: faster, with the same views."""
DIRECTIONS = 192
NEAR_SHARE = 0.15
"""The part of a view nearer than this share of the place's scale should be almost empty."""
NEAR_PLANE = 0.3
"""A near plane up to this share of the place's scale leaves what is looked at."""
NEAR_CLEAR = 0.7
"""Share of light that must get through that near part, in the mean over the view."""
SHARP = 0.008
"""Usual deviation of a splat over its distance from a camera (5 pixels in a view 640 wide)."""
SHARP_SPREAD = math.log(8.0)
"""One standard deviation of its logarithm. It is wide, since scenes of few large splats are seen from the same
distance."""
AGREEMENT_POWER = 3
SEEN_POWER = 1.5
"""A witness that n views show as well as the best place counts (1 + n)^-SEEN_POWER."""
APART = 0.2
"""Views nearer to each other than this share of the place's scale add less."""
FILLED = 0.3
"""A view counts in full if matter fills this share of it, and less if it shows more of the void."""
UNITS = 2.0**20
"""Merits and wants are whole numbers up to this. The sum of their products is exact in float64."""


@dataclass(frozen=True)
class Rig:
    """Automatic cameras.

    Attributes
    ----------
    cameras : list of Camera
        World coordinates, named auto_000, auto_001, ... in order of what they add, so that every hold-out is a mixture.
    near : float
        Scene units: a larger near plane would cut off what the views show.
    note : str
        How the cameras were placed, for the summary.
    """

    cameras: list[Camera]
    near: float
    note: str


def automatic_rig(
    source: Gaussians,
    views: int = DEFAULT_VIEWS,
    width: int = DEFAULT_SIZE[0],
    height: int = DEFAULT_SIZE[1],
    up: np.ndarray | None = None,
) -> Rig:
    """Place cameras for a scene that has none; the same scene always gets the same cameras.

    Parameters
    ----------
    source : SceneSource
        Checked: finite and not empty.
    views : int, optional
        Number of cameras.
    width, height : int, optional
        Pixels.
    up : np.ndarray, optional
        [3], the direction of up in the scene's frame, of any length but zero. Default: what the scene itself tells, else -y.

    Raises
    ------
    InputError
        If less than one view is asked for.
    """
    if views < 1:
        raise InputError(f"{views} automatic views: expected at least 1")
    scene = gather_witnesses(source)
    focal = width / 2 / math.tan(FIELD_OF_VIEW / 2)
    frames = Frames(DIRECTIONS, math.atan(math.sqrt(width * height / math.pi) / focal))
    stage = _Stage(scene, *_best_places(scene, open_places(scene)), frames)
    chosen = _choose(stage, views)
    places = stage.places
    at, forward = places.at[:, [p for p, _ in chosen]], np.array([line for _, line in chosen]).T
    found = find_up(scene, Stands(places.at, stage.merit.sum(axis=1), forward)) if up is None else given_up(up)
    cameras = [
        look(f"auto_{index:03d}", place + source.origin, line, found.direction, width, height, focal)
        for index, (place, line) in enumerate(zip(at.T, forward.T))
    ]
    near = float(f"{NEAR_PLANE * float(places.scale[[p for p, _ in chosen]].min()):.2g}")
    return Rig(cameras, near, f"{_placed(scene, at)}; {found.note}")


def _best_places(scene: Witnesses, places: Places) -> tuple[Places, np.ndarray, np.ndarray]:
    """The candidates that show most, their merit and the light that reaches them (see `_merit`)."""
    merit = light = np.empty((0, 0))
    for part, kept in ((scene.thinned(QUICK), 2 * POSITIONS), (scene, POSITIONS)):
        merit, shown, light = _merit(part, places)
        least = SHOWN_SHARE[bool(scene.tells.any())] * shown.max()
        rank = np.where(shown >= least, merit.sum(axis=1), 0.0)
        best = np.argsort(-rank, kind="stable")
        # Each lattice keeps its best places, so that all parts of the scene are looked at closely.
        turn = np.empty(places.count, np.int64)
        for kind in range(int(places.kind.max()) + 1):
            own = best[places.kind[best] == kind]
            turn[own] = np.arange(own.size)
        quota = kept // (2 * (int(places.kind.max()) + 1))
        first = turn[best] < quota
        best = np.concatenate([best[first], best[~first]])[:kept]
        best = best[rank[best] > 0] if rank.any() else best[:1]
        places, merit, light = places.take(best), merit[best], light[best]
    return places, merit, light


def _merit(scene: Witnesses, places: Places) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How well places show the witnesses.

    Returns
    -------
    merit : np.ndarray
        [P, M] f64, how well each place shows each witness; whole numbers.
    shown : np.ndarray
        [P] f64, how much of the scene a place should show; whole numbers.
    light : np.ndarray
        [P, M] f64, the share of light that gets through.
    """
    light = scene.transmittance(places.at)
    merit = light * scene.weights
    shown = np.empty(places.count)
    sizes = np.log(np.maximum(scene.sizes, 1e-300) / SHARP)
    most = float(scene.weights.max())
    for row in range(places.count):
        eye = places.at[:, row]
        lines = scene.means - eye[:, None]
        distance = np.sqrt((lines * lines).sum(axis=0))
        angles = (sizes - np.log(np.maximum(distance, 1e-300))) / SHARP_SPREAD
        merit[row] *= scene.agreement(eye) ** AGREEMENT_POWER
        shown[row] = np.rint(merit[row] * (UNITS / most)).sum()
        merit[row] *= np.exp(-0.5 * angles * angles)
    merit *= UNITS / max(float(merit.max()), 1e-300)
    return np.rint(merit, out=merit), shown, light


class _Stage:
    """Candidates with all that is known of the views from them."""

    def __init__(self, scene: Witnesses, places: Places, merit: np.ndarray, light: np.ndarray, frames: Frames) -> None:
        self.scene, self.places, self.merit, self.frames = scene, places, merit, frames
        self.lines = scene.means[:, None] - places.at[:, :, None]
        self.distance = np.sqrt((self.lines * self.lines).sum(axis=0))
        self.lines /= np.maximum(self.distance, 1e-300)
        self.bins = bins_of(self.lines)
        self.angles = self._angles(light)
        self.filled = np.array([frames.sums(bins, row) for bins, row in zip(self.bins, self.angles)])
        self.filled = np.clip(self.filled / UNITS, 1 / UNITS, 1.0)
        self.worth = self._clear() * self.filled**2

    def _clear(self) -> np.ndarray:
        """[P, D] f64, 1 in directions where almost nothing is near, else next to nothing."""
        directions, places = self.frames.directions.T, self.places
        ahead = NEAR_SHARE * places.scale
        skin = self.scene.matter.skin(places.at)
        ends = places.at[:, :, None] + directions[:, None] * (ahead + skin)[:, None]
        through = self.scene.matter.transmittance(places.at, ends, np.broadcast_to(skin[:, None], ends.shape[1:]))
        through = np.rint(through * UNITS)
        clear = np.empty(through.shape, bool)
        for column, line in enumerate(self.frames.directions):
            around = self.frames.holds(line, directions)
            clear[:, column] = through[:, around].sum(axis=1) >= NEAR_CLEAR * UNITS * around.sum()
        # If no place is clear, the best of the others is taken.
        return np.where(clear, 1.0, 1e-6)

    def _angles(self, light: np.ndarray) -> np.ndarray:
        """[P, M] f64, what each witness stands for fills so many times the share FILLED of a view; whole numbers."""
        scene = self.scene
        frame = 2 * math.pi * (1 - self.frames.limit)
        areas = scene.share * 2 * math.pi * scene.weights * scene.areas(self.lines)
        with np.errstate(over="ignore"):
            angles = areas / np.maximum(self.distance, 1e-150) ** 2
        whole: np.ndarray = np.rint(np.minimum(angles / (FILLED * frame), 1.0) * light * UNITS)
        return whole

    def aimed(self, place: int, line: np.ndarray) -> np.ndarray:
        """A direction of view ([3]), turned to the middle of what fills the view."""
        lines = self.lines[:, place]
        for _ in range(2):
            middle = (lines * (self.angles[place] * self.frames.holds(line, lines))).sum(axis=1)
            length = math.sqrt(float((middle * middle).sum()))
            if length > 0:
                line = middle / length
        return line


def _choose(stage: _Stage, views: int) -> list[tuple[int, np.ndarray]]:
    """(place, direction of view) of each view; each next view is the one that adds most."""
    merit, places = stage.merit, stage.places
    seen, room = np.zeros(merit.shape[1]), np.ones(places.count)
    # A witness counts with the root of what the best place shows of it: rare and faint ones are to be seen too.
    fullest = np.maximum(merit.max(axis=0), 1.0)
    merit = np.rint(merit * np.sqrt(UNITS / fullest))
    fullest = np.maximum(merit.max(axis=0), 1.0)
    # The gain of a view only falls, so an older gain is an upper bound. Few places are looked at again for each view.
    bounds, directions = np.full(places.count, np.inf), np.zeros(places.count, np.int64)
    chosen: list[tuple[int, np.ndarray]] = []
    for _ in range(views):
        wanted = np.rint(UNITS * (1 + seen) ** -SEEN_POWER)
        fresh = np.zeros(places.count, bool)
        while not fresh[best := int(np.argmax(bounds))]:
            gains = stage.frames.sums(stage.bins[best], merit[best] * wanted) * stage.worth[best] * room[best]
            directions[best] = np.argmax(gains)
            bounds[best], fresh[best] = gains[directions[best]], True
        line = stage.frames.directions[directions[best]]
        if stage.filled[best, directions[best]] < 1:
            line = stage.aimed(best, line)
        chosen.append((best, line))
        seen += stage.frames.holds(line, stage.lines[:, best]) * (merit[best] / fullest)
        apart = places.at - places.at[:, best, None]
        apart = (apart * apart).sum(axis=0) / (APART * places.scale) ** 2
        room *= np.rint(UNITS * (1 - 0.7 * np.exp(-0.5 * apart))) / UNITS
    return chosen


def look(
    name: str, position: np.ndarray, direction: np.ndarray, up: np.ndarray, width: int, height: int, focal: float
) -> Camera:
    """A camera at `position` that looks along `direction`; the top of the image points to `up` (all [3], world)."""
    forward = direction / _length(direction)
    right = np.cross(forward, up)
    if _length(right) < 1e-3:  # straight up or down: any roll will do
        right = np.cross(forward, np.roll(up, 1))
    right /= _length(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    shift = -(rotation * position).sum(axis=1)
    return Camera(name, width, height, rotation, shift, focal, focal, (width - 1) / 2, (height - 1) / 2)


def _length(line: np.ndarray) -> float:
    return math.sqrt(float((line * line).sum()))


def _placed(scene: Witnesses, places: np.ndarray) -> str:
    whole = scene.whole
    inside = float(np.mean(np.all(np.abs(places - whole.middle[:, None]) < whole.half[:, None], axis=0)))
    kind = "inside out" if inside > 0.75 else "from outside" if inside < 0.25 else "from inside and outside"
    told = "where SH are strongest" if scene.tells.any() else "by what is in sight (no SH tell where cameras stood)"
    return f"{places.shape[1]} automatic views {kind}, placed {told}"
