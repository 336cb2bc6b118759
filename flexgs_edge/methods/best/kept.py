"""The Gaussians that a multiplier keeps, and the colours that a refit of them gave.

A search hands these from candidate to candidate, so that each refit goes on from the last one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flexgs_edge.memory.rows import blocks, put_rows, read_rows
from flexgs_edge.memory.storage import IN_MEMORY, Storage

COLOURS = ("sh_dc", "sh_rest")


@dataclass
class Refitted:
    """Colours after a refit, from which the next one starts.

    Attributes
    ----------
    rows : np.ndarray
        [n] i64, places in the rows of `PruneRounds`, ascending.
    degrees : np.ndarray
        [n] u8, SH degrees at the time of the refit.
    planes : dict
        Their colours ([width, n] f32 by field).
    """

    rows: np.ndarray
    degrees: np.ndarray
    planes: dict[str, np.ndarray]

    @classmethod
    def of(
        cls,
        rows: np.ndarray,
        degrees: np.ndarray,
        order: np.ndarray,
        planes: dict[str, np.ndarray],
        storage: Storage = IN_MEMORY,
    ) -> Refitted:
        """Take the colours of `planes`, whose columns belong to `rows[order]`, back into the order of `rows`."""
        back = storage.empty((len(order),), np.int64)
        back[order] = np.arange(len(order))
        return cls(rows, degrees, {name: storage.take(planes[name], back) for name in COLOURS})

    def apply(
        self, rows: np.ndarray, degrees: np.ndarray, planes: dict[str, np.ndarray], storage: Storage = IN_MEMORY
    ) -> dict[str, np.ndarray]:
        """`planes` with these colours, where a row was refitted with the same SH degree."""
        if not len(self.rows) or not len(rows):
            return planes
        changed = {name: storage.empty(planes[name].shape, planes[name].dtype) for name in self.planes}
        for part in blocks(len(rows)):
            some = rows[part]
            at = np.minimum(np.searchsorted(self.rows, some), len(self.rows) - 1)
            same = np.flatnonzero((self.rows[at] == some) & (self.degrees[at] == degrees[part]))
            span = slice(int(at[0]), int(at[-1]) + 1)
            for name, values in changed.items():
                to, places = read_rows(planes[name], part).copy(), at[same] - span.start
                # The grid may lack the highest SH degrees. Coefficients lie channel by channel, so we go by channel.
                both = (v.reshape(3, -1, v.shape[-1]) for v in (to, self.planes[name]))
                for held, new in zip(*both, strict=True):
                    for plane, moved in zip(held, new, strict=False):
                        plane[same] = read_rows(moved, span).take(places)
                put_rows(values, part, to)
        return {**planes, **changed}


@dataclass
class Kept:
    """The Gaussians that a multiplier keeps.

    Attributes
    ----------
    snapshot : int
        Number of the snapshot that they were chosen from.
    rows : np.ndarray
        [n] i64, places in the rows of `PruneRounds`, ascending.
    planes : dict
        Stored planes of these rows ([width, n] f32 by field), with SH dropped.
    degrees : np.ndarray
        [n] u8, SH degrees.
    weight2 : np.ndarray
        [n] f64, sums of squared weights.
    left_out : int
        How many rows were left out because the grid would be coarser with them (`reachable`).
    """

    snapshot: int
    rows: np.ndarray
    planes: dict[str, np.ndarray]
    degrees: np.ndarray
    weight2: np.ndarray
    left_out: int = 0

    def take(self, keep: np.ndarray, storage: Storage = IN_MEMORY) -> Kept:
        """The rows for which `keep` ([n] bool) is True."""
        if keep.all():
            return self
        rows = np.flatnonzero(keep)
        planes = {name: storage.take(values, rows) for name, values in self.planes.items()}
        some, weight2 = storage.take(self.rows, rows), storage.take(self.weight2, rows)
        return Kept(self.snapshot, some, planes, self.degrees[rows], weight2)
