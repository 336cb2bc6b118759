"""Scenes with their SH cut to a lower degree."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexgs_edge.scene.fields import sh_rest_count
from flexgs_edge.scene.source import Planes, Rows, SceneSource


class TrimmedSource(SceneSource):
    """A scene with SH up to a lower degree, and without SH where `keeps_sh` ([N] bool) is false."""

    def __init__(self, parent: SceneSource, keeps_sh: np.ndarray, degree: int) -> None:
        self.parent, self.keeps_sh = parent, keeps_sh
        self.name, self.origin, self.notes, self.count = parent.name, parent.origin, parent.notes, parent.count
        self.sh_degree = min(degree, parent.sh_degree)
        self.sh_count = self.count if self.sh_degree else 0

    def read(self, rows: Rows, fields: Sequence[str], out: Planes | None = None) -> Planes:
        """See `SceneSource.read`."""
        rows, planes = self.begin_read(rows, fields, out)
        self.parent.read(rows, [name for name in fields if name != "sh_rest"], planes)
        if "sh_rest" in planes and self.sh_degree:
            whole = self.parent.read(rows, ["sh_rest"])["sh_rest"] * self.keeps_sh[rows]
            planes["sh_rest"][...] = lower_degree(whole, self.sh_degree)
        return planes


def lower_degree(sh_rest: np.ndarray, degree: int) -> np.ndarray:
    """[3 K', n] SH up to `degree` from [3 K, n] SH. Both lie channel by channel.

    >>> lower_degree(np.arange(24.0).reshape(24, 1), 1).ravel().tolist()
    [0.0, 1.0, 2.0, 8.0, 9.0, 10.0, 16.0, 17.0, 18.0]
    """
    channels = sh_rest.reshape(3, sh_rest.shape[0] // 3, -1)[:, : sh_rest_count(degree)]
    return np.ascontiguousarray(channels.reshape(-1, sh_rest.shape[1]))
