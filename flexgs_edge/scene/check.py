"""Check a scene before work starts: at least one Gaussian, finite values, usable rotations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexgs_edge.errors import InputError
from flexgs_edge.scene.fields import FIELDS
from flexgs_edge.scene.source import Planes, Rows, SceneSource, SelectSource

_TINY = np.finfo(np.float32).tiny
SH_LARGEST = 1e15
"""Larger SH coefficients are invalid: squares of their colours leave float32, and infinity times a weight of zero is
NaN."""


class _Faults:
    """Invalid rows: how many for each reason, and the first of them."""

    def __init__(self) -> None:
        self.count, self.first = 0, -1
        self.reasons: dict[str, tuple[int, int]] = {}

    def add(self, start: int, bad: np.ndarray, reason: str) -> None:
        rows = np.flatnonzero(bad)
        if rows.size:
            count, first = self.reasons.get(reason, (0, start + int(rows[0])))
            self.reasons[reason] = (count + rows.size, first)

    def __str__(self) -> str:
        return ", ".join(f"{why} in {count} (first row {first})" for why, (count, first) in self.reasons.items())


def check_scene(source: SceneSource, drop_invalid: bool = False, chunk_rows: int = 65536) -> SceneSource:
    """Check every value of a scene, one chunk at a time.

    A row is invalid if a field has NaN or infinity, or an SH coefficient is beyond `SH_LARGEST`. It is also invalid if
    the norm of its quaternion is zero, or outside the range that float32 can normalise. Log-scales of -inf (flat
    splats) are valid: they are read as the smallest finite log-scale of the scene.

    Parameters
    ----------
    source : SceneSource
        The scene.
    drop_invalid : bool, optional
        Leave invalid rows out. By default, they raise an error.
    chunk_rows : int, optional
        Rows held in memory at a time.

    Returns
    -------
    SceneSource
        `source` itself, or a lazy source over it, with a note on the rows that were left out or clamped.

    Raises
    ------
    InputError
        If the scene is empty or has invalid rows. The message tells how many, in which fields, and the first row.
    """
    if source.count == 0:
        raise InputError(f"{source.name}: the scene is empty: it has no Gaussians")
    if source.valid:
        return source
    faults = _Faults()
    keep = np.ones(source.count if drop_invalid else 0, bool)
    flat, smallest = 0, np.float32(np.inf)
    for rows in source.chunks(chunk_rows):
        bad, scales = _check_chunk(source, rows, faults)
        if drop_invalid:
            keep[rows] = ~bad
        scales = scales[:, ~bad]
        without = np.isneginf(scales)
        flat += int(without.any(axis=0).sum())
        smallest = min(smallest, scales.min(initial=np.float32(np.inf), where=~without))
    if faults.count and not drop_invalid:
        raise InputError(
            f"{source.name}: {faults.count} of {source.count} Gaussians are invalid: {faults}; "
            "use --drop-invalid to leave them out"
        )
    if faults.count == source.count:
        raise InputError(f"{source.name}: all {source.count} Gaussians are invalid: {faults}")
    if faults.count:
        note = f"{faults.count} of {source.count} Gaussians left out as invalid: {faults}"
        source = SelectSource(source, np.flatnonzero(keep), (note,))
    if flat:
        if not np.isfinite(smallest):
            raise InputError(f"{source.name}: log_scales: all are -inf; expected finite values")
        source = _FlatSource(source, smallest, flat)
    return source


def _check_chunk(source: SceneSource, rows: slice, faults: _Faults) -> tuple[np.ndarray, np.ndarray]:
    """Find the invalid rows of a chunk; returns [n] bool, and the chunk's log-scales."""
    bad = np.zeros(rows.stop - rows.start, bool)
    scales = np.empty((0, 0), np.float32)
    for field in FIELDS:
        values = source.read(rows, [field.name])[field.name]
        finite = np.isfinite(values)
        if field.name == "log_scales":
            finite |= np.isneginf(values)
            scales = values
        broken = np.asarray(~finite.all(axis=0))
        faults.add(rows.start, broken, f"NaN or infinity in {field.name}")
        bad |= broken
        if field.name in ("sh_dc", "sh_rest"):
            glaring = ~broken & (np.abs(values) > SH_LARGEST).any(axis=0)
            faults.add(rows.start, glaring, f"values beyond +-{SH_LARGEST:g} in {field.name}")
            bad |= glaring
        if field.name == "quats":
            with np.errstate(over="ignore", under="ignore", invalid="ignore"):
                norm = np.square(values).sum(axis=0, dtype=np.float32)
                useless = ~broken & ~((norm >= _TINY) & (norm < np.inf))
            faults.add(rows.start, useless, "quats of norm zero (or beyond float32)")
            bad |= useless
    faults.count += int(bad.sum())
    return bad, scales


class _FlatSource(SceneSource):
    """A source whose log-scales are raised to at least `floor`."""

    def __init__(self, parent: SceneSource, floor: np.float32, count: int) -> None:
        self.parent, self.floor = parent, np.float32(floor)
        self.name, self.count, self.sh_degree = parent.name, parent.count, parent.sh_degree
        self.sh_count, self.origin = parent.sh_count, parent.origin
        note = f"{count} flat Gaussians: log-scales of -inf set to the smallest finite one, {float(floor):.4g}"
        self.notes = (*parent.notes, note)

    def read(self, rows: Rows, fields: Sequence[str], out: Planes | None = None) -> Planes:
        """See `SceneSource.read`."""
        planes = self.parent.read(rows, fields, out)
        if "log_scales" in planes:
            np.maximum(planes["log_scales"], self.floor, out=planes["log_scales"])
        return planes
