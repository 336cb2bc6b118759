"""Read columns of planes in another order, such as the Morton order of a file, without holding the planes in memory."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from flexgs_edge.memory.rows import COPY_ROWS, blocks, put_rows, read_ahead, read_listed, read_rows
from flexgs_edge.memory.storage import IN_MEMORY, Storage


class OrderedPlanes:
    """Columns of planes in another order, read in parts.

    Planes in memory are indexed when they are read. Planes in files are reordered first, one by one; otherwise every
    part would read pages all over every plane.

    `planes`: [width, n] of each field. `order`: [n], the row that comes at each place; None keeps the order. `storage`:
    holds the reordered planes.
    """

    def __init__(self, planes: Mapping[str, np.ndarray], order: np.ndarray | None, storage: Storage) -> None:
        self._planes, self._order = dict(planes), order
        if order is not None and storage.spills:
            self._planes = {name: storage.take(values, order) for name, values in planes.items() if name != "means"}
            self._order = None

    def parts(self, count: int, *fields: str) -> Iterator[tuple[slice, list[np.ndarray]]]:
        """Yield the first `count` rows part by part: their slice, and [width, m] of each field."""
        planes = [self._planes[field] for field in fields]
        if self._order is None:
            yield from read_ahead(count, *planes)
            return
        for rows in blocks(count):
            yield rows, [values[:, self._order[rows]] for values in planes]

    def band(self, degree: int, rows: np.ndarray) -> np.ndarray:
        """[3, 2l + 1, m], the coefficients of SH degree l of the given rows."""
        values = self._planes["sh_rest"]
        band = slice(degree * degree - 1, (degree + 1) ** 2 - 1)
        rgb = values.reshape(3, len(values) // 3, values.shape[1])[:, band]
        return read_listed(rgb, rows if self._order is None else self._order[rows])


def stable_order(keys: np.ndarray, storage: Storage = IN_MEMORY, rows: int = 1 << 22) -> np.ndarray:
    """Argsort as `np.argsort(keys, kind="stable")`, with about `rows` keys in memory at a time.

    We split the keys by value into parts of about equal size, estimated from a sample, and sort one part after the
    other. Equal keys always fall into one part.

    Returns [n] i64.
    """
    count = len(keys)
    if not storage.spills or count <= rows:
        return np.argsort(keys, kind="stable")
    order = storage.empty((count,), np.int64)
    sample = np.sort(keys[:: max(count // 65536, 1)])
    parts = -(-2 * count // rows)
    edges = np.unique(sample[[len(sample) * part // parts for part in range(1, parts)]])
    at = 0
    for low, high in zip([None, *edges], [*edges, None], strict=True):
        chosen = []
        for part in blocks(count, COPY_ROWS):
            some = read_rows(keys, part)
            inside = np.ones(len(some), bool) if low is None else some >= low
            if high is not None:
                inside &= some < high
            chosen.append(part.start + np.flatnonzero(inside))
        places = np.concatenate(chosen)
        put_rows(order, slice(at, at + len(places)), places[np.argsort(keys[places], kind="stable")])
        at += len(places)
    return order
