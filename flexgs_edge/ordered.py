"""Columns of planes in another order."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from flexgs_edge.scratch import Room, read_listed, read_rows


class OrderedPlanes:
    """Columns of planes in another order (None: their own), read in parts.

    From memory they are looked up as they are asked for. In files all are put in order first, plane by plane: otherwise places
    all over every plane would be read for each part.
    """

    def __init__(self, planes: Mapping[str, np.ndarray], order: np.ndarray | None, room: Room) -> None:
        self._planes, self._order = dict(planes), order
        if order is not None and room.spills:
            self._planes = {name: room.take(values, order) for name, values in planes.items() if name != "means"}
            self._order = None

    def of(self, field: str, rows: slice) -> np.ndarray:
        """[width, m] of some rows."""
        values = self._planes[field]
        values = values.reshape(-1, values.shape[-1])
        return read_rows(values, rows) if self._order is None else values[:, self._order[rows]]

    def band(self, degree: int, rows: np.ndarray) -> np.ndarray:
        """[3, 2l + 1, m] coefficients of one SH degree of some rows."""
        values = self._planes["sh_rest"]
        band = slice(degree * degree - 1, (degree + 1) ** 2 - 1)
        rgb = values.reshape(3, len(values) // 3, values.shape[1])[:, band]
        return read_listed(rgb, rows if self._order is None else self._order[rows])
