"""Which way is up: what the format's convention says, unless the scene itself shows otherwise.

Scenes come in COLMAP's frame, x right, y down, z forward, so up is -y. Two things in a scene can override that, where
they are clear. People walk around a thing more than they climb: cameras all around lie near a plane, and up is its
normal. And a ground is one large flat surface with the rest of the scene on one side. Up need not be an axis.
"""

import math
from dataclasses import dataclass

import numpy as np

from flexgs_edge.cameras.directions import Frames, bins_of
from flexgs_edge.cameras.scene_sample import SceneSample, Splats

CONVENTION = (0.0, -1.0, 0.0)  # Up in COLMAP's frame
RING_POWER = 4  # A place counts by this power of what it shows: places near the training cameras show far more
RING_FLAT = 0.5
"""Cameras lie near a plane if they scatter along its normal by less than this share of their scatter within it."""
RING_ROUND = 0.5  # The least scatter within the plane over the largest: less is a line of cameras, which has no plane
RING_TELLING = 0.5  # SH of at least this share of the Gaussians must tell where cameras stood
FRONTAL = 0.7
"""If views look along a normal by more than this (a mean of cosines), they face a wall, and the normal is not up."""
ONE_WAY = 0.6  # If the mean direction of views within the plane is longer than this, cameras did not go around
LEVEL = 0.1  # Views do not tell the sign of up if their mean direction is within this of level
FLAT = 0.4  # A splat has a normal if its smallest deviation is less than this share of the middle one
ALIKE = math.radians(12.0)  # Normals within this angle are alike
APART = math.radians(30.0)
"""Other surfaces are told from the largest by more than this angle between the normals, or by another height."""
CANDIDATES = 300  # Directions that are tried for the normal
LARGEST_AREA = 20.0  # A splat counts with at most so many times the median area: a few huge ones are no ground
SLAB = 0.03  # Thickness of a ground over the scene's extent
GROUND = 0.1  # Least share of all flat splats that lie in a ground
GROUND_ROWS = 60  # Least number of sampled splats in a ground
DOMINANT = 2.0  # A ground is so many times larger than any other surface: the faces of a box or a room are alike
ABOVE = 0.85  # Of what is not in the ground, this share lies above it
BESIDE = 0.05  # Least share of the scene's opacity outside the ground
ALONG = {"camera ring": math.radians(12.0), "ground": math.radians(3.0)}
"""Up is an axis if it is this near to one. A ground is known better than a ring."""
AGREEING = math.radians(25.0)  # Ground and ring agree if they are within this angle
DIGITS = 6  # Normals are rounded to so many decimals, so that all machines find the same


@dataclass(frozen=True)
class Up:
    """A direction, and where it comes from."""

    direction: np.ndarray  # [3] f64, of length 1
    reason: str  # convention, ground, camera ring, ground and camera ring, or --up

    @property
    def note(self) -> str:
        """For the summary."""
        return f"up is {axis_name(self.direction)} ({self.reason})"


@dataclass(frozen=True)
class Stands:
    """Where cameras probably stood, and the views that were chosen."""

    at: np.ndarray  # [3, P] f64, the best places
    strength: np.ndarray  # [P] f64, what each shows
    forward: np.ndarray  # [3, V] f64, directions of the chosen views


def find_up(scene: SceneSample, stands: Stands) -> Up:
    """The direction of up: from the ground, the ring of cameras, or the convention."""
    told = scene.share >= RING_TELLING
    ring = _ring(stands) if told else None
    ground = _ground(scene.sample, scene.whole.extent)
    if ground is not None and told and abs(float((stands.forward.mean(axis=1) * ground).sum())) > FRONTAL:
        ground = None
    if ring is None and ground is None:
        return Up(np.array(CONVENTION), "convention")
    if ground is None or ring is None:
        direction, reason = (ring, "camera ring") if ground is None else (ground, "ground")
        assert direction is not None
        return Up(_along_axis(_signed(direction, stands, ground is not None), ALONG[reason]), reason)
    if abs(float((ring * ground).sum())) < math.cos(AGREEING):
        return Up(_along_axis(_signed(ring, stands, False), ALONG["camera ring"]), "camera ring")
    return Up(_along_axis(ground, ALONG["ground"]), "ground and camera ring")


def given_up(up: np.ndarray) -> Up:
    """The direction that the user gave, of any length but zero."""
    return Up(unit(np.asarray(up, np.float64)), "--up")


def axis_name(direction: np.ndarray) -> str:
    """A direction as words: an axis, or three numbers."""
    axis = int(np.argmax(np.abs(direction)))
    if abs(direction[axis]) > 1 - 1e-12:
        return f"{'-' if direction[axis] < 0 else '+'}{'xyz'[axis]}"
    return ", ".join(f"{value:.3f}" for value in direction)


def unit(line: np.ndarray) -> np.ndarray:
    """`line` at length 1. Its size is divided out first, so that squares stay finite."""
    line = line / np.abs(line).max()
    return line / math.sqrt(float((line * line).sum()))


def _ring(stands: Stands) -> np.ndarray | None:
    """Normal of the plane that cameras around the scene lie near, of either sign."""
    weights = (stands.strength / max(float(stands.strength.max()), 1e-300)) ** RING_POWER
    weights = weights / weights.sum()
    away = stands.at - (stands.at * weights).sum(axis=1)[:, None]
    size = float(np.abs(away).max())
    if not size > 0:
        return None
    scatter = _scatter(away / size, weights)
    values, lines = np.linalg.eigh(scatter)
    flat, narrow, wide = np.sqrt(np.maximum(values, 0.0))
    if flat > RING_FLAT * narrow or narrow < RING_ROUND * wide:
        return None
    normal = unit(np.round(lines[:, 0], DIGITS))
    mean = stands.forward.mean(axis=1)
    down = float((mean * normal).sum())
    level = mean - down * normal
    if abs(down) > FRONTAL or math.sqrt(float((level * level).sum())) > ONE_WAY:
        return None
    return normal


def _ground(sample: Splats, extent: float) -> np.ndarray | None:
    """Normal of the ground, towards what stands on it."""
    order = np.argsort(sample.deviations, axis=0, kind="stable")
    ordered = np.sort(sample.deviations, axis=0)
    flat = ordered[0] < FLAT * ordered[1]
    if flat.sum() < GROUND_ROWS:
        return None
    normals = np.take_along_axis(sample.turns, order[None, :1], axis=1)[:, 0, flat]
    areas = ordered[1, flat] * ordered[2, flat]
    weights = sample.opacity[flat] * np.minimum(areas / np.median(areas), LARGEST_AREA)
    # Whole numbers, so that all machines find the same.
    weights = np.rint(weights * 2.0**20)
    total = float(weights.sum())
    frames = Frames(CANDIDATES, ALIKE)
    votes = frames.sums(bins_of(normals), weights) + frames.sums(bins_of(-normals), weights)
    slabs: list[float] = []
    ground = None
    for _ in range(3):
        guess = int(np.argmax(votes))
        normal = _mean_normal(frames.directions[guess], normals, weights)
        aligned = np.abs(_dot(normal, normals)) > math.cos(ALIKE)
        votes[np.abs(_dot(normal, frames.directions.T)) > math.cos(APART)] = 0
        votes[guess] = 0
        if not aligned.any():
            continue
        heights = _dot(normal, sample.means[:, flat][:, aligned])
        first, rows, found = _slabs(heights, weights[aligned], SLAB * extent)
        if not slabs:
            if found[0] < GROUND * total or rows < GROUND_ROWS:
                return None
            ground = _upward(normal, first, SLAB * extent, sample)
        slabs += found
    return ground if max(slabs[1:], default=0.0) * DOMINANT <= slabs[0] else None


def _slabs(heights: np.ndarray, weights: np.ndarray, thickness: float) -> tuple[float, int, list[float]]:
    """Lower end, number of splats and weight of the heaviest slab, and the weight of the next one at another height."""
    order = np.argsort(heights, kind="stable")
    heights, total = heights[order], np.concatenate([[0.0], np.cumsum(weights[order])])
    ends = np.searchsorted(heights, heights + thickness, side="right")
    inside = total[ends] - total[:-1]
    best = int(np.argmax(inside))
    other = (heights > heights[best] + 2 * thickness) | (heights < heights[best] - 2 * thickness)
    return float(heights[best]), int(ends[best]) - best, [float(inside[best]), float(inside[other].max(initial=0.0))]


def _upward(normal: np.ndarray, low: float, thickness: float, sample: Splats) -> np.ndarray | None:
    """`normal`, towards the side of the slab that almost all else is on; None if that is neither side."""
    heights = _dot(normal, sample.means)
    above = float(sample.opacity[heights > low + 1.5 * thickness].sum())
    below = float(sample.opacity[heights < low - 0.5 * thickness].sum())
    if above + below < BESIDE * float(sample.opacity.sum()) or max(above, below) < ABOVE * (above + below):
        return None
    return normal if above > below else -normal


def _mean_normal(normal: np.ndarray, normals: np.ndarray, weights: np.ndarray) -> np.ndarray:
    # The bins of the votes are wide, so that the first look must be wider.
    for angle in (2 * ALIKE, ALIKE, ALIKE, ALIKE):
        along = _dot(normal, normals)
        share = np.where(np.abs(along) > math.cos(angle), weights * np.sign(along), 0.0)
        mean = (normals * share).sum(axis=1)
        if not mean.any():
            break
        normal = unit(np.round(unit(mean), DIGITS))
    return normal


def _signed(direction: np.ndarray, stands: Stands, sure: bool) -> np.ndarray:
    """Choose the sign of up: people look down on a scene more than up."""
    if sure:
        return direction
    down = float((stands.forward.mean(axis=1) * direction).sum())
    if abs(down) > LEVEL:
        return -direction if down > 0 else direction
    # Level views: by the conventions of COLMAP (-y) and NeRF (+z).
    y, z = float(direction[1]), float(direction[2])
    return -direction if (y > 0 if abs(y) > abs(z) else z < 0) else direction


def _along_axis(direction: np.ndarray, angle: float) -> np.ndarray:
    axis = int(np.argmax(np.abs(direction)))
    if abs(direction[axis]) < math.cos(angle):
        return direction
    found = np.zeros(3)
    found[axis] = np.sign(direction[axis])
    return found


def _scatter(away: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """[3, 3] f64, weighted second moments of [3, n]; no product whose sum depends on threads."""
    return np.array([[float((weights * one * other).sum()) for other in away] for one in away])


def _dot(line: np.ndarray, points: np.ndarray) -> np.ndarray:
    """[n] f64, `line` ([3]) times `points` ([3, n]), without BLAS, whose threads are slow on a busy machine."""
    return line[0] * points[0] + line[1] * points[1] + line[2] * points[2]
