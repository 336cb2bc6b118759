"""Scenes of more Gaussians than there are: each in parts that look like it together, in tiles side by side; read lazily."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexgs_edge.errors import InputError
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.rotations import turned
from flexgs_edge.scene.source import Planes, Rows, SceneSource

OFFSET = 0.4
"""How far the halves of a Gaussian are moved along its longest axis, in its standard deviations. Nearer halves look
more like the whole, but overlap so much that they hardly count as two: docs/results/tuning.md#offset"""
ALONG = (1.0 - OFFSET**2) ** 0.5
"""Factor on the longest standard deviation: variance less the square of the offset, so that the pair keeps the second moment."""
ACROSS = 1.04
"""Factor on the two others. Renderers skip alphas below 1/255, which takes more of the fringe of a fainter Gaussian. A
little width gives it back: docs/results/tuning.md#across"""
CENTRE = 0.1
"""Share of the opacity that keeps the light through the middle; the rest keeps the sum of alphas:
docs/results/tuning.md#centre"""
MOST_PARTS = 8
"""Most parts of a Gaussian; beyond, scenes are tiled. More parts look too little like the whole:
docs/results/tuning.md#most_parts"""
_LOGIT_MOST, _LOG_SCALE_MOST = 80.0, 80.0
"""Beyond these a Gaussian is nothing or everything; exp stays finite."""
_OVERLAP = float(np.exp(-(OFFSET**2) / (2 * ALONG**2)))
"""Of each half's opacity, what reaches the middle between the two."""


def half_logits(logits: np.ndarray) -> np.ndarray:
    """Logits of the opacity of each half of Gaussians.

    Two rules pull apart, and neither does alone. Two halves of opacity h, of which `_OVERLAP` reaches the middle between them,
    let the same light through there as a whole of opacity a if (1 - h overlap)^2 = 1 - a. Of an opaque whole that pair is too
    much everywhere else. Of faint ones alphas simply add, and their sum along the axis stays if h = a / (2 ALONG).

    Parameters
    ----------
    logits : np.ndarray
        f64, any shape.

    Returns
    -------
    np.ndarray
        f64.

    >>> half_logits(np.array([0.0])).round(3)
    array([-0.956])
    """
    grown = np.exp(np.clip(logits, -_LOGIT_MOST, _LOGIT_MOST))
    clear = 1 / (1 + grown)
    opacity = grown * clear
    middle = opacity / (1 + np.sqrt(clear)) / _OVERLAP  # 1 - sqrt(1 - a) without its cancellation
    half = CENTRE * middle + (1 - CENTRE) * opacity / (2 * ALONG)
    result: np.ndarray = np.log(half / (1 - half))
    return result


class PartsSource(SceneSource):
    """`count` Gaussians made of those of `parent`.

    Gaussian g of tile t is the virtual row v = t * parent.count + g. The `count` rows are dealt out evenly over the V virtual
    ones: v has those from floor((v * count + phase) / V) on. So every row is known from its number alone, and any range in any
    order gives the same bits. A Gaussian becomes k parts by halving: the first half becomes ceil(k / 2), the second the rest.

    Parameters
    ----------
    parent : SceneSource
        Finite values (`check_scene`).
    count : int
        At least `parent.count`.
    shifts : np.ndarray
        [T, 3] f64: where each tile stands, in scene units; a tile's share is count / T.
    seed : int
        Chooses which Gaussians get one part more than others.
    """

    def __init__(self, parent: SceneSource, count: int, shifts: np.ndarray, seed: int = 0) -> None:
        self.parent, self.count, self.shifts = parent, count, np.asarray(shifts, np.float64)
        self.virtual = parent.count * len(self.shifts)
        if not self.virtual <= count < 2**31:  # products of two counts stay below 2^63
            raise InputError(f"{parent.name}: {count} Gaussians: expected {self.virtual} to {2**31 - 1}")
        self.phase = int(np.random.default_rng(seed).integers(self.virtual))
        self.name, self.sh_degree, self.origin = parent.name, parent.sh_degree, parent.origin
        self.sh_count = count if parent.sh_count else 0
        self.notes = parent.notes

    def read(self, rows: Rows, fields: Sequence[str], out: Planes | None = None) -> Planes:
        """See `SceneSource.read`; needs about 800 bytes a row beside the arrays and the parent's rows."""
        rows, planes = self.begin_read(rows, fields, out)
        numbers = np.arange(rows.start, rows.stop) if isinstance(rows, slice) else rows
        if not len(numbers) or not fields:
            return planes
        virtual = ((numbers + 1) * self.virtual - self.phase - 1) // self.count
        first = self._start(virtual)
        parts, part = self._start(virtual + 1) - first, numbers - first
        tile, gaussian = np.divmod(virtual, self.parent.count)
        for begin, end in _runs(tile):
            run = slice(begin, end)
            chosen, place = _distinct(gaussian[run])
            needed = set(fields) | ({"log_scales", "quats"} if "means" in fields else set())
            found = self.parent.read(chosen, [name for name in FIELD if name in needed])
            wide = {
                name: found[name][:, place].astype(np.float64) for name in found if name not in ("sh_dc", "sh_rest")
            }
            offsets = _halve(wide, parts[run], part[run])
            if "means" in fields:
                wide["means"] += turned(wide["quats"], offsets) + self.shifts[tile[begin]][:, None]
            for name in fields:
                values = wide.get(name)
                planes[name][:, run] = found[name][:, place] if values is None or name == "quats" else values
        return planes

    def _start(self, virtual: np.ndarray) -> np.ndarray:
        """The first row of a virtual row."""
        start: np.ndarray = (virtual * self.count + self.phase) // self.virtual
        return start


def _runs(tile: np.ndarray) -> list[tuple[int, int]]:
    """Ranges of rows of the same tile ([n] i64, ascending)."""
    cuts = [0, *(np.flatnonzero(np.diff(tile)) + 1).tolist(), len(tile)]
    return list(zip(cuts[:-1], cuts[1:]))


def _distinct(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The different numbers of a sorted list, and for each entry its place among them."""
    new = np.diff(rows, prepend=rows[0] - 1) != 0
    return rows[new], np.cumsum(new) - 1


def _halve(wide: Planes, parts: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Make each column of `wide` (f64; log-scales and logits in place) the part `part` of `parts`.

    Returns
    -------
    np.ndarray
        [3, n] f64: how far it moves along its own axes, scene units.
    """
    count, column = len(parts), np.arange(len(parts))
    offsets = np.zeros((3, count))
    scales, logits = wide.get("log_scales"), wide.get("opacity_logits")
    while (whole := parts == 1).sum() < count:
        first = (parts + 1) // 2
        second = part >= first  # never where there is one part
        if scales is not None:
            longest = scales.argmax(axis=0)
            far = np.exp(np.minimum(scales[longest, column], _LOG_SCALE_MOST)) * OFFSET
            offsets[longest, column] += np.where(whole, 0.0, np.where(second, far, -far))
            narrower = np.full((3, count), np.log(ACROSS))
            narrower[longest, column] = np.log(ALONG)
            narrower[:, whole] = 0.0
            scales += narrower
        if logits is not None:
            logits[:] = np.where(whole, logits, half_logits(logits))
        part = np.where(second, part - first, part)
        parts = np.where(second, parts - first, first)
    return offsets
