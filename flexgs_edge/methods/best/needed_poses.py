"""Further poses to score, where the others see too little: between given poses, and beside views that lose too much.

A Gaussian that few scored poses see looks cheap to remove, and fits only these poses. So another view that shows it may break,
and a search that mends this by finer steps alone would end at several times the bytes: docs/results/tuning.md#needed
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.generated import between
from flexgs_edge.cameras.nearness import nearest
from flexgs_edge.cameras.order import SAME_VIEW, in_picture

LEAST_GAIN = 0.2
"""A pose is needed if it adds at least this share of its own picture to what the scored ones see:
docs/results/tuning.md#needed"""
GAIN_DIGITS = 4
"""Decimals in comparisons of what a pose adds."""
NEIGHBOURS = 6
"""A given pose and each of so many nearest ones make a pose half way between them, if that is needed."""
BESIDE = 4
"""So many given poses nearest to a view that lost too much make poses half way to it."""
MOST_TIMES = 2
"""Needed poses are at most so many times the given ones that are scored."""
POINTS = 512
"""Most points that tell what poses see."""


def needed_poses(
    scored: Sequence[Camera],  # poses that are scored already, given and made ones
    given: Sequence[Camera],  # the given ones among them
    rest: Sequence[Camera],  # Given poses that are not scored. They may be needed as they are.
    deciding: Sequence[Camera],
    points: np.ndarray,  # [3, n] f64, a sample of the scene's positions, world coordinates
    near: float,  # near plane, scene units
) -> list[Camera]:
    """The poses that add enough to what the scored ones see, each next one the one that adds most.

    A point adds 1 / (1 + k) to a pose that has it in its picture. Each other pose that shows the point adds to k, as in
    `covering_order`, and less if it shows the point smaller: by the square of the ratio of its sizes in both pictures.
    What a pose adds is the mean over the points in its picture. Occlusion is ignored.

    `deciding`: the views that decide. They are not scored, but poses half way to them are, if they are needed.
    """
    points = points[:, :: -(-points.shape[1] // POINTS)] if points.shape[1] else points
    there = [_seen(camera, points, near) for camera in scored]
    found = [(camera, _seen(camera, points, near)) for camera in rest]
    for camera, other in _pairs(given, deciding, there, points, near):
        middle = between(camera, other)
        found.append((middle, _seen(middle, points, near)))
    known = [_known(seen, there) for _, seen in found]
    needed: list[Camera] = []
    while found and len(needed) < MOST_TIMES * len(given):
        gains = [_gain(seen, already) for (_, seen), already in zip(found, known, strict=True)]
        best = int(np.argmax(gains))
        if gains[best] < LEAST_GAIN:
            break
        camera, added = found.pop(best)
        known.pop(best)
        needed.append(camera)
        for (_, seen), already in zip(found, known, strict=True):
            already += _known(seen, [added])
    return needed


def poses_beside(view: Camera, given: Sequence[Camera]) -> list[Camera]:
    """Poses half way between a view and the given poses nearest to it.

    `view`: a view that lost too much. `given`: the given poses that are scored.
    """
    return [between(given[place], view) for place in nearest(view, given, BESIDE)]


@dataclass(frozen=True)
class _Seen:
    """Which points a pose shows ([n] bool), their directions ([3, n] f64), and their distances in focal lengths ([n] f64)."""

    shown: np.ndarray
    ahead: np.ndarray
    away: np.ndarray


def _seen(camera: Camera, points: np.ndarray, near: float) -> _Seen:
    ahead = points - camera.center[:, None]
    away = np.maximum(np.sqrt(np.square(ahead).sum(axis=0)), np.finfo(np.float64).tiny)
    return _Seen(in_picture(camera, points, near), ahead / away, away / camera.fx)


def _known(seen: _Seen, others: Sequence[_Seen]) -> np.ndarray:
    """[n] f64, how often other poses show each point from about the same direction."""
    known = np.zeros(len(seen.shown))
    for other in others:
        alike = np.maximum(1.0 - (1.0 - (seen.ahead * other.ahead).sum(axis=0)) / SAME_VIEW, 0.0)
        known += other.shown * alike * np.square(np.minimum(seen.away / other.away, 1.0))
    return known


def _gain(seen: _Seen, known: np.ndarray) -> float:
    gain = np.where(seen.shown, 1.0 / (1.0 + known), 0.0).sum() / max(np.count_nonzero(seen.shown), 1)
    return round(float(gain), GAIN_DIGITS)


def _pairs(
    given: Sequence[Camera], deciding: Sequence[Camera], there: Sequence[_Seen], points: np.ndarray, near: float
) -> list[tuple[Camera, Camera]]:
    """Neighbours of which one at least would add enough itself: all others have enough poses round them."""
    pairs: dict[tuple[int, int], None] = {}
    for place, camera in enumerate(given):
        own = there[place]
        if _gain(own, _known(own, [*there[:place], *there[place + 1 :]])) >= LEAST_GAIN:
            for other in nearest(camera, given, NEIGHBOURS):
                pairs[min(place, other), max(place, other)] = None
    found = [(given[first], given[second]) for first, second in pairs]
    scored = {id(camera) for camera in given}
    for view in deciding:
        if id(view) in scored:
            continue
        own = _seen(view, points, near)
        if _gain(own, _known(own, there)) >= LEAST_GAIN:
            found += [(given[place], view) for place in nearest(view, given, BESIDE)]
    return found
