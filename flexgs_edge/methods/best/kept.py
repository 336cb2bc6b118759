"""What a multiplier keeps, and the colours that a refit of it gave."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from flexgs_edge.memory.rows import blocks, put_rows, read_rows
from flexgs_edge.memory.storage import IN_MEMORY, Storage

COLOURS = ("sh_dc", "sh_rest")


@dataclass
class Refitted:
    """Values after a refit (colours) or a descent (all), by row of the scene (ascending): where the next one starts."""

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
        fields: Iterable[str] = COLOURS,
    ) -> Refitted:
        """Of the changed fields of `planes`, whose columns belong to `rows[order]`; rows ascending."""
        back = storage.empty((len(order),), np.int64)
        back[order] = np.arange(len(order))
        return cls(rows, degrees, {name: storage.take(planes[name], back) for name in fields})

    def apply(
        self, rows: np.ndarray, degrees: np.ndarray, planes: dict[str, np.ndarray], storage: Storage = IN_MEMORY
    ) -> dict[str, np.ndarray]:
        """`planes` with these values: geometry wherever a row was kept, colours where it was with the same SH degree."""
        if not len(self.rows) or not len(rows):
            return planes
        changed = {name: storage.empty(planes[name].shape, planes[name].dtype) for name in self.planes}
        for part in blocks(len(rows)):
            some = rows[part]
            at = np.minimum(np.searchsorted(self.rows, some), len(self.rows) - 1)
            kept = self.rows[at] == some
            alike = kept & (self.degrees[at] == degrees[part])
            span = slice(int(at[0]), int(at[-1]) + 1)
            for name, values in changed.items():
                same = np.flatnonzero(alike if name in COLOURS else kept)
                to, places = read_rows(planes[name], part).copy(), at[same] - span.start
                # Of colours a grid may have lost its highest degrees: coefficients are channel by channel.
                channels = 3 if name in COLOURS else 1
                both = (v.reshape(channels, -1, v.shape[-1]) for v in (to, self.planes[name]))
                for held, new in zip(*both, strict=True):
                    for plane, moved in zip(held, new, strict=False):
                        plane[same] = read_rows(moved, span).take(places)
                put_rows(values, part, to)
        return {**planes, **changed}


@dataclass
class Kept:
    """What a multiplier keeps.

    Attributes
    ----------
    snapshot : int
        Number of the snapshot that was asked.
    rows : np.ndarray
        [n] i64, rows of the scene.
    planes : dict
        Of these rows, with SH dropped.
    degrees : np.ndarray
        [n] u8, SH degrees.
    weight2 : np.ndarray
        [n] f64, sums of squared weights.
    left_out : int
        Rows that would have asked for coarser steps of all others, and went.
    """

    snapshot: int
    rows: np.ndarray
    planes: dict[str, np.ndarray]
    degrees: np.ndarray
    weight2: np.ndarray
    left_out: int = 0

    def take(self, keep: np.ndarray, storage: Storage = IN_MEMORY) -> Kept:
        """Some of the rows: [n] bool."""
        if keep.all():
            return self
        rows = np.flatnonzero(keep)
        planes = {name: storage.take(values, rows) for name, values in self.planes.items()}
        return Kept(
            self.snapshot, storage.take(self.rows, rows), planes, self.degrees[rows], storage.take(self.weight2, rows)
        )
