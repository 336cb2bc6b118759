"""Enlarge a scene for tests and studies: split Gaussians into parts that look like the whole, and tile copies.

Rows are computed when they are read.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexgs_edge.errors import InputError
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.rotations import turned
from flexgs_edge.scene.source import Planes, Rows, SceneSource

OFFSET = 0.4
"""Distance of each half from the centre along the longest axis, in standard deviations. Nearer halves look more like
the whole, but overlap so much that they hardly count as two: docs/results/tuning.md#offset"""
ALONG = (1.0 - OFFSET**2) ** 0.5
"""Factor on the longest standard deviation: the pair of halves keeps the variance along that axis."""
ACROSS = 1.04
"""Factor on the two other standard deviations. Renderers skip alphas below 1/255, which cuts more off fainter
Gaussians; a little more width makes up for it: docs/results/tuning.md#across"""
CENTRE = 0.1
"""Weight of the opacity that keeps the light through the middle; the rest of the weight keeps the sum of alphas:
docs/results/tuning.md#centre"""
MOST_PARTS = 8
"""Most parts of a Gaussian; larger scenes are tiled. More parts look too little like the whole:
docs/results/tuning.md#most_parts"""
_LOGIT_MOST, _LOG_SCALE_MOST = 80.0, 80.0
"""Clamps on logits and log-scales: beyond them a Gaussian shows nothing or everything, and exp stays finite."""
_OVERLAP = float(np.exp(-(OFFSET**2) / (2 * ALONG**2)))
"""Share of each half's opacity that reaches the middle between the two."""


def half_logits(logits: np.ndarray) -> np.ndarray:
    """Logits of the opacity of each half, given the logits of whole Gaussians.

    We mix two rules, since neither is enough. Let a be the opacity of the whole and h that of a half, of which the
    share `_OVERLAP` reaches the middle. The pair lets the same light through the middle if (1 - h overlap)^2 = 1 - a.
    But for an opaque whole, this pair is too dense everywhere else. For faint Gaussians alphas simply add: their sum
    along the axis stays if h = a / (2 ALONG).

    Parameters
    ----------
    logits : np.ndarray
        f64, any shape.

    Returns
    -------
    np.ndarray
        f64, of the same shape.

    >>> half_logits(np.array([0.0])).round(3)
    array([-0.956])
    """
    grown = np.exp(np.clip(logits, -_LOGIT_MOST, _LOGIT_MOST))
    clear = 1 / (1 + grown)
    opacity = grown * clear
    middle = opacity / (1 + np.sqrt(clear)) / _OVERLAP  # equals 1 - sqrt(1 - a), without cancellation
    half = CENTRE * middle + (1 - CENTRE) * opacity / (2 * ALONG)
    result: np.ndarray = np.log(half / (1 - half))
    return result


class PartsSource(SceneSource):
    """`count` Gaussians, made by splitting and tiling those of `parent`.

    Gaussian g of tile t is the virtual row v = t * parent.count + g, of V in all. The rows are dealt out evenly: the
    parts of v begin at row floor((v * count + phase) / V). So the number of a row tells all about it, and any range in
    any order has the same bits. A Gaussian becomes k parts by halving: its first half becomes ceil(k / 2) parts, its
    second the rest.

    Parameters
    ----------
    parent : SceneSource
        Finite values (`check_scene`).
    count : int
        At least `parent.count`.
    shifts : np.ndarray
        [T, 3] f64, the place of each tile, scene units; a tile has count / T rows.
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
        self.notes, self.settings, self.held_bytes = parent.notes, parent.settings, parent.held_bytes

    def read(self, rows: Rows, fields: Sequence[str], out: Planes | None = None) -> Planes:
        """See `SceneSource.read`; needs about 800 bytes a row, beside the arrays and the rows of the parent."""
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
        """The first row of each virtual row."""
        start: np.ndarray = (virtual * self.count + self.phase) // self.virtual
        return start


def _runs(tile: np.ndarray) -> list[tuple[int, int]]:
    """Split rows into ranges of the same tile ([n] i64, ascending)."""
    cuts = [0, *(np.flatnonzero(np.diff(tile)) + 1).tolist(), len(tile)]
    return list(zip(cuts[:-1], cuts[1:]))


def _distinct(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The different numbers of a sorted list, and the place of each entry among them."""
    new = np.diff(rows, prepend=rows[0] - 1) != 0
    return rows[new], np.cumsum(new) - 1


def _halve(wide: Planes, parts: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Turn each column of `wide` into one of its parts: number `part` of `parts`.

    Log-scales and logits (f64) change in place.

    Returns
    -------
    np.ndarray
        [3, n] f64, the shift of each column along its own axes, scene units.
    """
    count, column = len(parts), np.arange(len(parts))
    offsets = np.zeros((3, count))
    scales, logits = wide.get("log_scales"), wide.get("opacity_logits")
    while (whole := parts == 1).sum() < count:
        first = (parts + 1) // 2
        second = part >= first  # False if there is only one part
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
