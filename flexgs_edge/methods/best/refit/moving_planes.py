"""The values of a scene in scratch files that a descent moves: where each chunk lies, and how it comes to be drawn."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from flexgs_edge.kernels.backend import Backend
from flexgs_edge.memory.rows import copy_rows
from flexgs_edge.methods.best.refit.chunk_state import ORDER, widths
from flexgs_edge.methods.best.refit.descent import GRID_VALUES
from flexgs_edge.render.chunk_bounds import ChunkBounds
from flexgs_edge.render.fit import padded
from flexgs_edge.scene.source import SceneSource


@dataclass
class Part:
    """Where a chunk's state lies in the files, and what is still to be done to it.

    `at`, `powers_at`: first element in the files of planes, and in that of powers.
    """

    base: int
    count: int
    degree: int
    at: int
    powers_at: int
    # Whether a step has moved the chunk. Before, its running means of gradients are zero and not in the files.
    stepped: bool = False
    mean: str = "none"  # whether there is a mean of the values, and whether it is in its file or equal to the values
    # Shares by which the mean is still to follow the values as they are.
    pending: list[float] = field(default_factory=list)

    @property
    def stride(self) -> int:
        """Rows in the files."""
        return padded(self.count)

    @property
    def span(self) -> slice:
        """Elements in the files of planes."""
        return slice(self.at, self.at + sum(widths(self.degree).values()) * self.stride)

    @property
    def powers_span(self) -> slice:
        """Elements in the file of powers."""
        return slice(self.powers_at, self.powers_at + 2 * self.stride)


class MovingPlanes:
    """Fills the chunks that views are drawn from (`ChunkPlanes`): values put on their grids."""

    def __init__(self, backend: Backend, source: SceneSource) -> None:
        self.backend, self.origin = backend, source.origin
        self.count, self.sh_count, self.sh_degree = source.count, source.sh_count, source.sh_degree
        self.bounds: dict[int, ChunkBounds] = {}
        self.parts: dict[int, Part] = {}
        self.values = np.zeros(0, np.float32)
        self.steps = backend.array((GRID_VALUES,), np.float32)
        self._room: Any = None
        self._drawn: Callable[[], None] = lambda: None

    def load(self, start: int, stop: int, planes: dict[str, Any]) -> None:
        """Put rows [start, stop) on the grid, into arrays of the backend."""
        part, stride = self.parts[start], padded(stop - start)
        shape = (sum(widths(part.degree).values()), stride)
        self._drawn()
        if self._room is None or self._room.shape != shape:
            self.close_room()
            self._room = self.backend.array(shape, np.float32)
        with self.backend.mapped(self._room) as host:
            copy_rows(self.values, part.span, host.reshape(-1))
        stored = [planes[name] for name in ORDER]
        self.backend.launch("snap", (stride,), stride, part.degree, self.steps, self._room, *stored)
        self._drawn = self.backend.mark()
        if start not in self.bounds:
            self.bounds[start] = bounds_of(self.backend, stored[0], stored[1], stop - start)

    def close_room(self) -> None:
        """Free the room for the values of a chunk."""
        if self._room is not None:
            self._room.release()
            self._room = None

    def close(self) -> None:
        """Free everything."""
        self.close_room()
        self.steps.release()


def bounds_of(backend: Backend, means: Any, log_scales: Any, count: int) -> ChunkBounds:
    """Bounds of the first `count` rows of planes on the backend."""
    return ChunkBounds.of(backend.read(means)[:, :count], backend.read(log_scales)[:, :count])


def parts_of(spans: Iterable[tuple[int, int, int]]) -> list[Part]:
    """Lay chunks (first row, row after the last, SH degree) out in the files, one after the other."""
    parts: list[Part] = []
    at = powers_at = 0
    for start, stop, degree in spans:
        parts.append(Part(start, stop - start, degree, at, powers_at))
        at, powers_at = parts[-1].span.stop, parts[-1].powers_span.stop
    return parts
