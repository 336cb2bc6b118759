"""The frame of all readers that hold a file's packed values in memory and decode rows when they are asked for."""

from abc import abstractmethod
from collections.abc import Sequence

import numpy as np

from flexgs_edge.io.frames import Frame
from flexgs_edge.memory.rows import blocks
from flexgs_edge.scene.fields import FIELD, OPACITY_LIMIT, sh_rest_count
from flexgs_edge.scene.source import Planes, Rows, SceneSource, by_chunk

_BLOCK_ROWS = 16384  # Rows decoded at a time, so that intermediate arrays stay small


class DecodedSource(SceneSource):
    """A scene whose packed values lie in memory, in the file's own frame.

    `name`: the user's path, for messages. `count`: Gaussians. `sh_degree`: 0 to 4. `held_bytes`: bytes that the packed
    values take in memory. `settings`: how the file says that it is drawn, such as `{"antialiased": True}`.
    """

    frame: Frame | None = None  # the frame that the file itself states; `None`: that of its format

    def __init__(self, name: str, count: int, sh_degree: int, held_bytes: int = 0) -> None:
        self.name, self.count, self.sh_degree = name, count, sh_degree
        self.sh_count = count if sh_degree else 0
        self.origin = np.zeros(3)
        self.held_bytes = held_bytes

    @abstractmethod
    def decode(self, rows: Rows, field: str) -> np.ndarray:
        """Values of one field, [width, n] f32 or f64, in the file's frame.

        `rows` is `slice(start, stop)` within the scene, or [n] i64.
        """

    def read(self, rows: Rows, fields: Sequence[str], out: Planes | None = None) -> Planes:
        """See `SceneSource.read`; needs about 4 MB beside the arrays."""
        rows, planes = self.begin_read(rows, fields, out)
        size = rows.stop - rows.start if isinstance(rows, slice) else len(rows)
        for part in blocks(size, _BLOCK_ROWS):
            some: Rows = (
                slice(rows.start + part.start, rows.start + part.stop) if isinstance(rows, slice) else rows[part]
            )
            for field, plane in planes.items():
                if FIELD[field].width(self.sh_degree):
                    # Values beyond float32 become infinite here, and check_scene reports them.
                    with np.errstate(over="ignore", invalid="ignore"):
                        plane[:, part] = self.decode(some, field)
        return planes


class PartsSource(DecodedSource):
    """Parts one behind the other, each with a SH degree of its own; SH above it are zero.

    `counts`, `degrees`: Gaussians and SH degree of each part.
    """

    def __init__(self, name: str, counts: Sequence[int], degrees: Sequence[int], held_bytes: int) -> None:
        super().__init__(name, sum(counts), max(degrees, default=0), held_bytes)
        self._degrees, self._starts = degrees, np.cumsum([0, *counts[:-1]], dtype=np.int64)

    @abstractmethod
    def decode_part(self, number: int, rows: Rows, field: str) -> np.ndarray:
        """As `decode`, of rows that are counted within a part."""

    def decode(self, rows: Rows, field: str) -> np.ndarray:
        size = rows.stop - rows.start if isinstance(rows, slice) else len(rows)
        values = np.zeros((FIELD[field].width(self.sh_degree), size))
        for number, some, place in by_chunk(rows, self._starts):
            start, degree = int(self._starts[number]), self._degrees[number]
            own: Rows = slice(some.start - start, some.stop - start) if isinstance(some, slice) else some - start
            if field != "sh_rest":
                values[:, place] = self.decode_part(number, own, field)
            elif degree:
                found = self.decode_part(number, own, field).reshape(3, sh_rest_count(degree), -1)
                values.reshape(3, -1, size)[:, : found.shape[1], place] = found
        return values


def opacity_logits(opacities: np.ndarray, limit: float = OPACITY_LIMIT) -> np.ndarray:
    """f64 logits of opacities in [0, 1], clamped to +-`limit`; NaN stays NaN.

    The default is for opacities of 8 bits, whose 0 and 1 mean "nearly".

    >>> opacity_logits(np.array([0.0, 0.5, 1.0])).tolist()
    [-7.0, 0.0, 7.0]
    """
    wide = np.asarray(opacities, np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        logits: np.ndarray = np.clip(np.log(wide / (1 - wide)), -limit, limit)
    return logits
