"""What the codec's kernels share with their host side: the device that runs them, and how numbers lie in their arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from flexgs_edge.codec.v2.groups import Group

_SPARE = 96
"""Numbers of every plane behind those of the rows: what vectors load and store beyond them."""
# Of a chunk: what is wanted and found; as in the kernel.
INFO = ("rows", "lanes", "words", "status", "found", "found high", "wanted", "at")
# Places in the record of an alphabet.
PLACES = {
    "start": 0,
    "shift": 2,
    "symbols": 3,
    "sizes": 4,
    "mean cuts": 8,
    "error cuts": 23,
    "slots": 38,
    "entries": 102,
    "mean weights": 166,
    "error weights": 183,
    "tables": 200,
    "counts": 202,
}
RECORD = 203
"""Numbers of a record."""
PLANES = {"cells": (2, "u8"), "weights": (8, "u2"), "bytes": (4, "u1"), "ints": (4, "i4"), "floats": (44, "f4")}
"""Work planes of a chunk."""


class Device(Protocol):
    """What of a kernel backend is used here."""

    threads: int
    """Work-items that run side by side as threads of a processor do; 0 where none do."""

    def array(self, shape: tuple[int, ...], dtype: Any) -> Any:
        """An array, not initialised."""

    def write(self, array: Any, values: np.ndarray, offset: int = 0) -> None:
        """Copy values into an array."""

    def read(self, array: Any, out: np.ndarray | None = None, offset: int = 0) -> np.ndarray:
        """Copy an array out."""

    def launch(self, name: str, size: tuple[int, ...], *args: Any) -> None:
        """Run a kernel."""


def launch_coding(
    device: Device,
    chunks: int,
    shape: tuple[int, int, int],
    shared: Sequence[Any],
    decoding: tuple[Sequence[int], Sequence[Any]] | None = None,
    counting: tuple[Sequence[int], Sequence[Any]] | None = None,
) -> None:
    """Run `code_chunks` in one of its directions.

    Parameters
    ----------
    shape : tuple of int
        Numbers of a plane, planes of codes, SH degree.
    shared : sequence of arrays
        What both directions use, in the kernel's order.
    decoding, counting : tuple, optional
        Numbers and arrays of the one direction that is wanted.
    """
    # The kernel leaves what belongs to the other direction alone: any array will do.
    numbers, arrays = decoding or ([0] * 3, [shared[0]] * 4)
    more_numbers, more_arrays = counting or ([0] * 4, [shared[0]] * 5)
    device.launch(
        "code_chunks",
        (chunks,),
        int(counting is not None),
        *shape,
        *numbers,
        *more_numbers,
        *shared,
        *arrays,
        *more_arrays,
    )


def padded(rows: int) -> int:
    """Numbers of a plane of so many rows."""
    return -(-rows // 16) * 16 + _SPARE


def pack_group(record: np.ndarray, group: Group) -> None:
    """A group's fitted numbers into its alphabet's record."""
    start = group.start
    record[PLACES["start"] : PLACES["symbols"]] = np.int64(start).astype(np.int32), start >> 32, group.shift
    sizes = [len(cut) for cut in group.cuts]
    record[PLACES["sizes"] : PLACES["mean cuts"]] = *sizes, group.kind.residual, group.kind.features
    for place, cuts in zip((PLACES["mean cuts"], PLACES["error cuts"]), group.cuts, strict=True):
        # Contexts count the cuts reached: their order says nothing, and the kernel looks at the lowest first.
        record[place : place + len(cuts)] = np.sort(cuts)
    for place, weights in zip((PLACES["mean weights"], PLACES["error weights"]), group.weights, strict=True):
        record[place : place + len(weights)] = weights
