"""Candidates for automatic views: what each shows, what it is worth, and which of them are needed."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.detail import UNITS as LOGS
from flexgs_edge.cameras.directions import Frames, bins_of, fibonacci, filled_share
from flexgs_edge.cameras.scene_sample import SceneSample
from flexgs_edge.constants import DEFAULT_HOLDOUT, DILATION
from flexgs_edge.small_matrices import cross

MOST_VIEWS = 400
SHOWN = 0.98
"""Views are enough when they show this share of all Gaussians that good views show, all together as well as the best of these."""
SIDE = 80  # Pixels along the side of a candidate's picture, a square of the same area as the view
LEAST_ANGLE = 0.002  # A Gaussian is shown well if its deviation is this, radians: a pixel of a view 640 wide
LOOKED_AT = 40.0, 20.0, 10.0  # Distances of the places around one that is not, in its deviations
LINES = 3  # Most directions of view from a place
TURNED = math.cos(math.radians(40.0))  # Directions of view from one place differ by more than this
SMEAR, SMEAR_FREE = 0.03, 0.1
"""Views count e times less for each step by which Gaussians are wider than those around them, in the mean of logs, beyond what
the sharpest tenth shows and what is free. Real cameras' views lie within .1 of each other, those from behind and from below .2
beyond."""
BLURRED_TIMES = 2.0  # What is free for the width of splats in the view, a factor
LEAST_SHARP, LEAST_WORTH = 0.1, 1e-4
"""Views that count less than this for what is too wide in them, or in all, are not taken at all."""
GOOD = 0.1  # Views are enough when they show what views show that are worth this share of the best, or more
DECIDING = 0.3  # Views that are worth less than this share of the best do not decide
NEW, LEAST_NEW, NEW_SHARP = 0.5, 0.001, 0.3
"""Views that show at least the second share of the Gaussians, of which all others together show less than the first share of what
can be shown of them, are taken however little they are worth, if they count so much for what is too wide in them."""
HIDDEN = 0.1  # Less of a Gaussian than this share is next to nothing
LARGER = 2.0  # Scored poses are half as far away as given ones, too: only what shows larger than in these is news
BLURRED = 0.15
"""Usual deviation of a view's splats, radians, beyond which it shows a blur: matter right before the lens or all around it."""
NEAR, NEAR_POWER = 0.3, 8
"""Light is from right before the lens if it comes from less than this share of the view's usual distance, from splats wider
than WIDE. Views count by this power of the share of all other light."""
WIDE = 0.1
ENCLOSED_POWER = 1
"""Places with matter on more than half of all sides count by this power of it: inside a room, not behind its walls."""
SHARP = 0.008  # Usual deviation of a splat over its distance from a camera (4 pixels in a view 640 wide)
SHARP_SPREAD = math.log(8.0)
"""One standard deviation of its logarithm. It is wide, since scenes of few large splats are seen from the same
distance."""
AGREEMENT_POWER = 2
APART = 0.1  # Views nearer to each other than this share of the distance of what they show add less
FILLED, FILLED_POWER = 0.3, 2
"""Views that matter fills less than this, or less than the usual good one, count by this power of how much less."""
FARTHEST = 1e9  # Candidates farther away, in extents of the smallest part, are left out: float32 must hold them
UNITS = 2.0**20  # Merits and wants are whole numbers up to this. The sum of their products is exact in float64.

Show = Callable[[Camera], tuple[np.ndarray, np.ndarray]]
"""Draws a view: the rows that it shows ([m] int64), and the sum of alpha T over the pixels for each ([m] f64)."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A candidate and what its picture shows.

    `at`, `line`: [3] f64, where it is, relative to the scene's origin, and where it looks. `clear`, `smear`,
    `blur`, `filled`, `distance`: What its worth follows from; the usual distance of what it shows, scene units.
    """

    at: np.ndarray
    line: np.ndarray
    step: float  # Distance to other candidates, scene units
    sides: float  # Share of all directions in which there is matter, about
    rows: np.ndarray  # [m] int64, what it shows
    part: np.ndarray  # [m] f64, how much of each, scene units squared
    close: np.ndarray  # [m] f64, 0 to 1, how well their sizes in the view suit it
    clear: float
    smear: float
    blur: float
    filled: float
    distance: float
    own: float = 1.0  # share of its light that comes from what is to be seen


class Stage:
    """Candidates with all that is known of them."""

    def __init__(self, scene: SceneSample, show: Show, frames: Frames, lens: float) -> None:
        self.scene, self.frames = scene, frames
        self.show, self.lens, self._focal = show, lens, SIDE * lens
        self.views: list[Candidate] = []
        self._most = np.zeros(scene.sizes.size)
        """The largest part of each Gaussian that any view shows, scene units squared."""
        self.seldom = 0.0
        """Share of the Gaussians that no good view shows."""

    def add_place(self, eye: np.ndarray, step: float) -> None:
        """Draw the views from a place ([3]) that should show most, if nothing hides it."""
        scene, frames = self.scene, self.frames
        lines, distance = _lines(scene.means, eye)
        bins = bins_of(lines)
        amounts = np.rint(UNITS * _close(np.log(scene.sizes / distance)) * scene.stands / float(scene.stands.max()))
        sums, sides = frames.sums(bins, amounts), filled_share(bins)
        most = float(sums.max())
        for _ in range(LINES):
            best = int(np.argmax(sums))
            if sums[best] <= 0.1 * most:
                break
            line = frames.directions[best]
            if sides < 0.5:
                held = np.flatnonzero(frames.holds(line, lines))
                line = _middle(lines.take(held, axis=1), amounts[held], line)
            self._draw(eye, line, step, sides)
            sums[_along(line, frames.directions.T) > TURNED] = 0

    def add_beside(self, view: Candidate) -> None:
        """Draw four views of the same: from two places beside, nearer and farther."""
        target = view.at + view.line * view.distance
        across = cross(view.line, np.eye(3)[int(np.argmin(np.abs(view.line)))])
        across /= _length(across)
        turn = 2.399963 * len(self.views)
        aside = math.cos(turn) * across + math.sin(turn) * cross(view.line, across)
        step = view.step / 2
        for move in (aside * step, -aside * step, 0.3 * view.line * view.distance, -0.4 * view.line * view.distance):
            eye = view.at + move
            line = target - eye
            self._draw(eye, line / max(_length(line), 1e-300), step, view.sides)

    def add_missing(self, count: int) -> None:
        """Draw views of `count` of the Gaussians that no view shows well, evenly spread over all of them."""
        best = np.zeros(self.scene.sizes.size)
        for view, worth in zip(self.views, self._worth() if self.views else ()):
            if worth:
                best[view.rows] = np.maximum(best[view.rows], view.close)
        missing = np.flatnonzero(best < _close(np.log([LEAST_ANGLE]))[0])
        self._add_views_of(missing, count)

    def add_view(self, eye: np.ndarray, line: np.ndarray, step: float) -> None:
        """Draw the view from a place ([3]) in a direction ([3])."""
        self._draw(eye, line, step, filled_share(bins_of(_lines(self.scene.means, eye)[0])))

    def _draw(self, eye: np.ndarray, line: np.ndarray, step: float, sides: float) -> None:
        scene, half = self.scene, (SIDE - 1) / 2
        if float(np.abs(eye).max()) > FARTHEST * scene.unit:
            return
        camera = look("small", eye / scene.unit, line, np.array([0.0, -1.0, 0.0]), SIDE, SIDE, self._focal)
        rows, weights = self.show(replace(camera, cx=half, cy=half))
        if not rows.size:
            return
        light = np.rint(weights * LOGS)
        total = float(light.sum())
        if not total:
            return
        distance, stands = _distances(scene.means.take(rows, axis=1), eye), scene.stands[rows]
        angles = scene.sizes[rows] / distance
        log_angles = np.log(np.maximum(angles, 1e-300))
        logs, blurs = np.rint(np.log(distance) * LOGS), np.rint(log_angles * LOGS)
        usual = float((light * logs).sum()) / total
        before = float(light[(angles > WIDE) & (logs < usual + math.log(NEAR) * LOGS)].sum()) / total
        blur = float((light * blurs).sum()) / total / LOGS
        filled = min(total / LOGS / SIDE**2, 1.0)
        # Pictures show splats wider than they are: tiny ones would seem large from far away.
        pixels = (self._focal * angles) ** 2 * stands
        part = weights * np.minimum(distance, 1e100) ** 2 * (pixels / (pixels + DILATION))
        self._most[rows] = np.maximum(self._most[rows], part)
        clear = (1 - before) ** NEAR_POWER * math.exp(-min((math.exp(min(blur, 50.0)) / BLURRED) ** 2, 600.0))
        clear *= min(filled / FILLED, 1.0) ** FILLED_POWER * max(0.5, sides) ** ENCLOSED_POWER
        smear = float((light * scene.smear[rows]).sum()) / total / LOGS
        self.views.append(
            Candidate(
                eye, line, step, sides, rows, part, _close(log_angles), clear * self._told(eye, rows, part), smear, blur,
                filled, math.exp(usual / LOGS), float(light[stands > 0].sum()) / total,
            )
        )  # fmt: skip

    def _told(self, eye: np.ndarray, rows: np.ndarray, part: np.ndarray) -> float:
        """How strong view-dependent colours are towards a place, over their mean over all directions; 1 without SH."""
        scene = self.scene
        if not scene.telling.size:
            return 1.0
        shown = np.zeros(scene.sizes.size)
        shown[rows] = part
        share = np.rint(UNITS * shown[scene.telling] / np.maximum(self._most[scene.telling], 1e-300))
        if not share.any():
            return 1.0
        return float(np.rint(share * scene.agreement(eye) ** AGREEMENT_POWER).sum() / float(share.sum()))

    def _worth(self) -> np.ndarray:
        """[V] f64, what each view is worth, 0 to 1."""
        clear, smear, blur, filled = (
            np.array([getattr(view, name) for view in self.views]) for name in ("clear", "smear", "blur", "filled")
        )
        good = np.rint(UNITS * clear * filled / max(float((clear * filled).max()), 1e-300))
        over = np.maximum(smear - _quantile(smear, good, 0.1) - SMEAR_FREE, 0.0)
        in_place = np.exp(-np.minimum(over / SMEAR, 600.0)) >= NEW_SHARP
        over += np.maximum(blur - _quantile(blur, good, 0.2) - math.log(BLURRED_TIMES), 0.0)
        sharp = np.rint(UNITS * np.exp(-np.minimum(over / SMEAR, 600.0))) / UNITS
        solid = np.minimum(filled / _quantile(filled, good, 0.5), 1.0) ** FILLED_POWER
        self.last = in_place & (clear * solid >= LEAST_WORTH * float((clear * solid).max()))
        """[V] bool, views that may be taken if nothing else shows what they show."""
        worth = np.where(sharp >= LEAST_SHARP, clear * sharp * solid, 0.0)
        worth = np.rint(UNITS * worth / max(float(worth.max()), 1e-300)) / UNITS
        return np.where(worth >= LEAST_WORTH, worth, 0.0)

    def choose(self, count: int | None, least: int = 0) -> list[Candidate]:
        """So many views, or `least` ones and as many more as are needed. Each next one is the one that adds most."""
        if not self.views:
            return []
        scene, worth = self.scene, self._worth()
        self.worth = worth
        largest, stands = np.maximum(self._most, 1e-300), np.rint(scene.stands)
        merits = [
            np.rint(1024 * view.part * view.close / largest[view.rows]) if each or last else np.zeros(view.rows.size)
            for view, each, last in zip(self.views, worth, self.last)
        ]
        shows = [float((merit * stands[view.rows]).sum()) for merit, view in zip(merits, self.views)]
        self.strength = worth * np.array(shows)
        fullest, most = np.zeros(scene.sizes.size), np.zeros(scene.sizes.size)
        for view, merit, each, last in zip(self.views, merits, worth, self.last):
            for largest, counts in ((fullest, each >= GOOD), (most, each or last)):
                if counts:
                    largest[view.rows] = np.maximum(largest[view.rows], merit)
        stands = np.rint(16 * scene.stands)
        needed = stands * (fullest > 0)
        self.seldom = 1 - float(needed.sum()) / max(float(stands.sum()), 1.0)
        fullest = np.maximum(np.where(fullest > 0, fullest, most), 1.0)
        stands *= most > 0
        most = np.maximum(most, 1.0)
        # A Gaussian counts with the root of what the best view shows of it: rare and faint ones are to be seen too.
        # One that stands for many counts for fewer: dense textures are not all there is to see.
        root = np.rint(16 * np.sqrt(scene.stands * np.sqrt(scene.stands)) * (needed > 0) * np.sqrt(1024 / fullest))
        shown = np.zeros(fullest.size)
        room = np.ones(len(self.views))
        # The gain of a view only falls, so an older gain is an upper bound. Few views are looked at again for each one.
        bounds = np.where(worth > 0, np.inf, 0.0)
        chosen: list[Candidate] = []
        at, lines = (np.array([getattr(view, name) for view in self.views]).T for name in ("at", "line"))
        distances = np.array([view.distance for view in self.views])
        new_only = False
        while len(chosen) < (count or MOST_VIEWS) and bounds.any():
            enough = float(needed[shown >= 1].sum()) >= SHOWN * float(needed.sum())
            if count is None and not new_only and len(chosen) >= least and enough:
                new_only, bounds = True, np.where(self.last, np.inf, 0.0)
                shown *= fullest / most
                fullest = most
            wanted = stands * (shown < NEW) if new_only else np.rint(root / (1 + shown))
            fresh = np.zeros(len(self.views), bool)
            while not fresh[best := int(np.argmax(bounds))]:
                view = self.views[best]
                if new_only:
                    bounds[best] = float(wanted[view.rows][merits[best] >= NEW * fullest[view.rows]].sum())
                else:
                    bounds[best] = float((merits[best] * wanted[view.rows]).sum()) * worth[best] * room[best]
                fresh[best] = True
            if new_only and bounds[best] < LEAST_NEW * float(stands.sum()):
                break
            view = self.views[best]
            chosen.append(view)
            shown[view.rows] += merits[best] / fullest[view.rows]
            away, turned = at - view.at[:, None], _along(view.line, lines)
            apart = (away * away).sum(axis=0) / np.maximum(APART * distances, 1e-300) ** 2
            apart += np.maximum(1 - turned, 0.0) * 8
            room *= np.rint(UNITS * (1 - 0.7 * np.exp(-0.5 * np.minimum(apart, 1000.0)))) / UNITS
            room[best] = bounds[best] = 0.0
        self._worths = {id(view): float(each) for view, each in zip(self.views, worth)}
        self._shares = {id(view): merits[self.views.index(view)] / fullest[view.rows] for view in chosen}
        return chosen

    def in_order(self, chosen: list[Candidate]) -> list[Candidate]:
        """The chosen views in an order in which every `DEFAULT_HOLDOUT`-th one, from the first, lies between others.

        These show most of what the others show too, each next one what those before it do not, and are worth something.
        """
        if not chosen:
            return []
        shares, total = [self._shares[id(view)] for view in chosen], np.zeros(self.scene.sizes.size)
        for view, share in zip(chosen, shares):
            total[view.rows] += share
        between: list[int] = []
        held = np.zeros(total.size)
        # What a view adds only falls, so what it added before is an upper bound. Below 0: not to be taken.
        bounds = np.where([self._worths[id(view)] >= DECIDING for view in chosen], np.inf, -1.0)
        while len(between) < -(-len(chosen) // DEFAULT_HOLDOUT):
            if not (bounds >= 0).any():
                bounds = np.where(np.isin(np.arange(len(chosen)), between), -1.0, np.inf)
            fresh: set[int] = set()
            while (best := int(np.argmax(bounds))) not in fresh:
                view, share = chosen[best], shares[best]
                others = total[view.rows] - share
                wanted = self.scene.stands[view.rows] * share * others / ((1 + others) * (1 + held[view.rows]))
                bounds[best] = float(np.rint(1024 * wanted).sum())
                fresh.add(best)
            between.append(best)
            bounds[best] = -1.0
            held[chosen[best].rows] += shares[best]
        last, first = iter(between), iter([turn for turn in range(len(chosen)) if turn not in between])
        return [chosen[next(first if place % DEFAULT_HOLDOUT else last)] for place in range(len(chosen))]

    def close_ups(self, chosen: list[Candidate], most: int) -> list[tuple[Candidate, int]]:
        """At most `most` views in place that show Gaussians much larger than the chosen ones do, and how many.

        Each next one adds most. A view shows a Gaussian if it shows half as much of it as any view or more.
        """
        self._add_hidden(chosen, most)
        self._worth()
        scene, seen = self.scene, np.zeros(self.scene.sizes.size)

        def shown(view: Candidate) -> tuple[np.ndarray, np.ndarray]:
            rows = view.rows[2 * view.part >= np.maximum(self._most[view.rows], 1e-300)]
            return rows, scene.sizes[rows] / _distances(scene.means.take(rows, axis=1), view.at)

        for rows, angles in map(shown, chosen):
            seen[rows] = np.maximum(seen[rows], angles)
        sharp = [view for view, last in zip(self.views, self.last) if last and math.exp(view.blur) < BLURRED]
        shows, stands = list(map(shown, sharp)), np.rint(16 * scene.stands)
        found: list[tuple[Candidate, int]] = []
        bounds, least = np.full(len(sharp), np.inf), LEAST_NEW * float(stands.sum())
        while len(found) < most and (bounds >= least).any():
            best = int(np.argmax(bounds))
            rows, angles = shows[best]
            # What a view adds only falls, so what it added before is an upper bound.
            bounds[best], before = float(stands[rows[angles > LARGER * seen[rows]]].sum()), bounds[best]
            if bounds[best] == before:
                seen[rows] = np.maximum(seen[rows], angles)
                found.append((sharp[best], round(before / 16)))
        return found

    def _add_hidden(self, chosen: list[Candidate], count: int) -> None:
        """Draw views of `count` of the Gaussians of which all chosen views together show next to nothing."""
        scene, most = self.scene, np.zeros(self.scene.sizes.size)
        for view in chosen:
            most[view.rows] = np.maximum(most[view.rows], view.part)
        opacity = 1 / (1 + np.exp(-scene.planes["opacity_logits"][0].astype(np.float64)))
        whole = 2 * math.pi * opacity * scene.sizes**2 * scene.stands * self._focal**2
        self._add_views_of(np.flatnonzero(most < HIDDEN * whole), count)

    def _add_views_of(self, rows: np.ndarray, count: int) -> None:
        """Draw views of `count` of some rows, evenly spread over all of them."""
        scene = self.scene
        directions = fibonacci(len(LOOKED_AT) * min(count, rows.size)).reshape(-1, len(LOOKED_AT), 3)
        for place, lines in enumerate(directions):
            row = rows[place * rows.size // len(directions)]
            for line, times in zip(lines, LOOKED_AT):
                distance = times * float(scene.sizes[row])
                self.add_view(scene.means[:, row] - line * distance, line, distance)


class ThingStage(Stage):
    """Candidates for views of one thing: Gaussians of others stand for none."""

    def _worth(self) -> np.ndarray:
        self.last = np.zeros(len(self.views), bool)
        worth = np.array([view.clear * view.own for view in self.views])
        return np.rint(UNITS * worth / max(float(worth.max()), 1e-300)) / UNITS


def _lines(means: np.ndarray, eye: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors ([3, n]) and distances ([n]) from `eye` ([3]) to `means` ([3, n])."""
    distance = _distances(means, eye)
    return (means - eye[:, None]) / distance, distance


def _distances(means: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """[n] f64, as of `_lines`."""
    x, y, z = (row - place for row, place in zip(means, eye))
    return np.maximum(np.sqrt(x * x + y * y + z * z), 1e-200)


def _close(log_angles: np.ndarray) -> np.ndarray:
    """[n] f64, 0 to 1, how well deviations over distances suit a view, from the logs of these angles."""
    off = (log_angles - math.log(SHARP)) / SHARP_SPREAD
    return np.exp(-0.5 * np.minimum(off * off, 1000.0))


def _middle(lines: np.ndarray, amounts: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Mean direction of `lines` ([3, n]) with `amounts`; `line` where they have none."""
    middle = (np.rint(lines * UNITS) * amounts).sum(axis=1)
    length = _length(middle)
    return middle / length if length > 0 else line


def _along(line: np.ndarray, lines: np.ndarray) -> np.ndarray:
    """Cosines between a direction ([3]) and others ([3, ...])."""
    return line[0] * lines[0] + line[1] * lines[1] + line[2] * lines[2]


def _quantile(values: np.ndarray, weights: np.ndarray, share: float) -> float:
    """A quantile of `values` with `weights`, whole numbers of the same shape."""
    order = np.argsort(values, axis=None, kind="stable")
    total = np.cumsum(weights.reshape(-1)[order])
    return float(values.reshape(-1)[order[int(np.searchsorted(total, share * total[-1]))]])


def look(
    name: str, position: np.ndarray, direction: np.ndarray, up: np.ndarray, width: int, height: int, focal: float
) -> Camera:
    """A camera at `position` that looks along `direction`; the top of the image points to `up` (all [3], world)."""
    forward = direction / _length(direction)
    right = cross(forward, up)
    if _length(right) < 1e-3:  # straight up or down: any roll will do
        right = cross(forward, np.roll(up, 1))
    right /= _length(right)
    rotation = np.stack([right, cross(forward, right), forward])
    shift = -(rotation * position).sum(axis=1)
    return Camera(name, width, height, rotation, shift, focal, focal, (width - 1) / 2, (height - 1) / 2)


def _length(line: np.ndarray) -> float:
    return math.sqrt(float((line * line).sum()))
