"""Places where a camera may stand: lattices in and around each part of a scene, without those in opaque matter."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flexgs_edge.cameras.directions import fibonacci
from flexgs_edge.cameras.witnesses import Part, Witnesses

LATTICE = 16
"""Most candidates along the longest side of a lattice."""
CANDIDATES = 6000
"""Candidates of all lattices together, about. More lattices are coarser each."""
MARGIN = 1.2
"""A lattice reaches so many half sides of its box to each side."""
WIDER = (1, 2, 4)
"""Lattices of a core, in half sides of its box. Cameras often stood outside the dense core that they looked at."""
BETWEEN = 1.5
"""Wider lattices end where they come this near to the size of the whole scene."""
OPEN_DEPTH = 0.25
"""Largest optical depth of a cell, along its side, in which a camera may stand."""
CLOSE_UPS = 48
"""Splats that get places of their own, if the scene is sparse."""
CLOSE_SIDES = 10
"""Places around each of them."""
CLOSE_DISTANCE = 5.5
"""Distance of these places in deviations of the splat. Three deviations to each side then fill the frame."""
SPARSE = 0.5
"""A scene is sparse if all its cross-sections together are less than this share of a circle around its box."""


@dataclass(frozen=True)
class Places:
    """Candidates.

    Attributes
    ----------
    at : np.ndarray
        [3, P] f64, positions relative to the scene's origin.
    scale : np.ndarray
        [P] f64, extent of the part of the scene that a place belongs to, scene units.
    kind : np.ndarray
        [P] int64, number of the lattice.
    """

    at: np.ndarray
    scale: np.ndarray
    kind: np.ndarray

    @property
    def count(self) -> int:
        """Number of candidates."""
        return self.scale.size

    def take(self, rows: np.ndarray) -> Places:
        """Some of the candidates."""
        return Places(self.at[:, rows], self.scale[rows], self.kind[rows])


def open_places(scene: Witnesses) -> Places:
    """Candidates in and around each part of a scene, and around single splats if it is sparse."""
    boxes = _boxes(scene.parts)
    side = min(LATTICE, math.floor((CANDIDATES / len(boxes)) ** (1 / 3) + 1e-9))
    found = [_open(scene, _lattice(box, side)) for box in boxes]
    scales = [np.full(at.shape[1], box.extent) for at, box in zip(found, boxes)]
    if is_sparse(scene):
        near, distances = _close_ups(scene)
        found.append(near)
        scales.append(distances)
    return Places(
        np.concatenate(found, axis=1),
        np.concatenate(scales),
        np.concatenate([np.full(at.shape[1], kind) for kind, at in enumerate(found)]),
    )


def is_sparse(scene: Witnesses) -> bool:
    """Say if a view of the whole scene would be almost empty."""
    area = float((scene.weights * scene.sizes**2).sum()) * 2 * scene.share
    return area < SPARSE * scene.whole.extent**2


def _boxes(parts: list[Part]) -> list[Part]:
    boxes = [parts[0]]
    for part in parts[1:]:
        for factor in WIDER:
            wider = Part(part.middle, part.half * factor)
            if factor == 1 or wider.extent * BETWEEN < parts[0].extent:
                boxes.append(wider)
    return boxes


def _lattice(box: Part, side: int) -> np.ndarray:
    """[3, n] f64, a cubic lattice in and around a box, with `side` places along the longest side."""
    reach = (1 + MARGIN) * np.maximum(box.half, 0.5 * box.half.max())
    step = 2 * float(reach.max()) / side
    axes = [np.arange(-math.floor(r / step + 1e-9), math.floor(r / step + 1e-9) + 1) * step for r in reach]
    lattice: np.ndarray = np.stack(np.meshgrid(*axes, indexing="ij")).reshape(3, -1) + box.middle[:, None]
    return lattice


def _open(scene: Witnesses, places: np.ndarray) -> np.ndarray:
    depth = scene.matter.optical_depth(places)
    # If there is thin fog everywhere, the clearest quarter is the best there is.
    kept: np.ndarray = places[:, depth <= max(OPEN_DEPTH, float(np.quantile(depth, 0.25)))]
    return kept


def _close_ups(scene: Witnesses) -> tuple[np.ndarray, np.ndarray]:
    """Places around the splats that show most: [3, n] f64, and their distances."""
    order = np.argsort(-scene.weights * scene.sizes**2, kind="stable")[:CLOSE_UPS]
    distances = CLOSE_DISTANCE * scene.sizes[order]
    offsets = fibonacci(CLOSE_SIDES).T
    places = scene.means[:, order, None] + distances[:, None] * offsets[:, None]
    around: np.ndarray = places.reshape(3, -1)
    return around, np.repeat(distances, CLOSE_SIDES)
