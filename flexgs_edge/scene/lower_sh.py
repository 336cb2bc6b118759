"""Scenes with their SH cut to a lower degree."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexgs_edge.scene.fields import sh_rest_count
from flexgs_edge.scene.source import Planes, Rows, SceneSource, WrappedSource


class TrimmedSource(WrappedSource):
    """A scene with SH up to a lower degree, and without SH where `keeps_sh` ([N] bool) is false."""

    def __init__(self, parent: SceneSource, keeps_sh: np.ndarray, degree: int, notes: tuple[str, ...] = ()) -> None:
        super().__init__(parent, notes)
        self.keeps_sh, self.sh_degree = keeps_sh, min(degree, parent.sh_degree)
        self.sh_count = parent.sh_count if self.sh_degree else 0

    def read(self, rows: Rows, fields: Sequence[str], out: Planes | None = None) -> Planes:
        """See `SceneSource.read`."""
        rows, planes = self.begin_read(rows, fields, out)
        self.parent.read(rows, [name for name in fields if name != "sh_rest"], planes)
        if "sh_rest" in planes and self.sh_degree:
            whole = self.parent.read(rows, ["sh_rest"])["sh_rest"] * self.keeps_sh[rows]
            planes["sh_rest"][...] = lower_degree(whole, self.sh_degree)
        return planes


def without_degrees(source: SceneSource, most: int | None) -> SceneSource:
    """`source` with SH up to degree `most`, and a note on what is left out; `source` itself if nothing is."""
    if most is None or source.sh_degree <= most:
        return source
    note = f"SH above degree {most} left out (the file has degree {source.sh_degree})"
    # Nobody asks which rows keep their SH if none does.
    return TrimmedSource(source, np.ones(source.count if most else 0, bool), most, (note,))


def lower_degree(sh_rest: np.ndarray, degree: int) -> np.ndarray:
    """[3 K', n] SH up to `degree` from [3 K, n] SH. Both lie channel by channel.

    >>> lower_degree(np.arange(24.0).reshape(24, 1), 1).ravel().tolist()
    [0.0, 1.0, 2.0, 8.0, 9.0, 10.0, 16.0, 17.0, 18.0]
    """
    width, count = sh_rest.shape
    channels = sh_rest.reshape(3, width // 3, count)[:, : sh_rest_count(degree)]
    return np.ascontiguousarray(channels.reshape(3 * channels.shape[1], count))
