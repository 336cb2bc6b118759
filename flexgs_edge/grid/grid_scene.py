"""A scene in integer codes, which a container codes and every decoder turns into values."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.memory.storage import IN_MEMORY, Storage

CODES = ("position", "scale", "rotation", "opacity", "dc")  # Arrays with a column for each row of a scene


@dataclass(frozen=True, eq=False)
class GridScene:
    """A scene in integer codes. Rows are sorted by layer, then along the Morton curve of their position cells."""

    count: int  # rows n
    sh_degree: int  # D; 0 if no row has SH
    origin: np.ndarray  # [3] f64, world: positions are relative to it
    step_sizes: StepSizes  # a value is its code times the step size
    position: np.ndarray  # [3, n] i32
    scale: np.ndarray  # [3, n] i32
    rotation: np.ndarray  # [3, n] i32: x, y, z of the unit quaternion, which has w >= 0 and no component larger than w
    opacity: np.ndarray  # [n] i32
    dc: np.ndarray  # [3, n] i32: Y, Co, Cg
    sh_degrees: np.ndarray  # [n] u8, 0 to D
    # For each degree l from 1 to D: [3 * (2l + 1), rows with a degree >= l] i32: all Y, all Co, all Cg.
    sh: tuple[np.ndarray, ...]
    layer: np.ndarray  # [n] u8, ascending; all 0 if there are no layers

    @property
    def sh_count(self) -> int:
        """Number of rows with SH above degree 0."""
        return int(np.count_nonzero(self.sh_degrees))

    def take(self, rows: np.ndarray, storage: Storage = IN_MEMORY) -> GridScene:
        """A new scene of the given rows, in their order, with the highest SH degree that is left."""
        rows = np.arange(self.count)[rows]
        degrees = self.sh_degrees[rows]
        top = int(degrees.max(initial=0))
        bands = tuple(storage.take(self.sh[d], row_places(self.sh_degrees, rows, d + 1)) for d in range(top))
        steps = replace(self.step_sizes, sh=self.step_sizes.sh[:top])
        codes: dict[str, Any] = {name: storage.take(getattr(self, name), rows) for name in CODES}
        changed: dict[str, Any] = {
            "count": len(rows),
            "sh_degree": top,
            "step_sizes": steps,
            "sh_degrees": degrees,
            "sh": bands,
        }
        return replace(self, layer=self.layer[rows], **changed, **codes)


def row_places(degrees: np.ndarray, rows: np.ndarray, degree: int) -> np.ndarray:
    """Columns of some rows in the SH arrays of a degree; rows below that degree have none."""
    places = np.cumsum(degrees >= degree) - 1
    return places[rows[degrees[rows] >= degree]]
