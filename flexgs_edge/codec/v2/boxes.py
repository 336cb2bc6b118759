"""Where the chunks of a file lie, for viewers that ask for the chunks in sight first (docs/format.md)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from flexgs_edge.codec.v2.chunk_plan import Chunk
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.memory.rows import read_rows

BOXES = "boxes"  # Its name among the settings of a file
FEWEST, MOST = 8, 4096  # Fewer chunks come one after the other anyway; of more, the header would grow too long


def with_boxes(settings: Mapping[str, Any], grid: GridScene, chunks: Sequence[Chunk]) -> dict[str, Any]:
    """The settings of a file of these chunks, with their boxes if there are enough of them.

    A box is seven integers: the least position codes x, y, z of the chunk's rows, the largest ones, and its rows with SH.
    """
    others = {name: value for name, value in settings.items() if name != BOXES}
    if not FEWEST <= len(chunks) <= MOST:
        return others
    return {**others, BOXES: [_box(grid, slice(chunk.start, chunk.stop)) for chunk in chunks]}


def _box(grid: GridScene, rows: slice) -> list[int]:
    position = read_rows(grid.position, rows)
    with_sh = int(np.count_nonzero(grid.sh_degrees[rows]))
    return [*position.min(axis=1).tolist(), *position.max(axis=1).tolist(), with_sh]
