"""Shared by the codec's kernels and their host code: the device protocol, and the layout of records and planes."""

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from flexgs_edge.codec.v2.groups import Group

_SPARE = 96  # Elements of each plane beyond its rows: vectors may load and store there
# Fields of a chunk's info record, for input and result; the kernel has the same order.
INFO = ("rows", "lanes", "words", "status", "found", "found high", "wanted", "at")
# Places in the record of an alphabet; the kernel has the same.
PLACES = {
    "start": 0, "shift": 2, "symbols": 3, "sizes": 4, "mean cuts": 8, "error cuts": 23, "slots": 38, "entries": 102,
    "mean weights": 166, "error weights": 183, "tables": 200, "counts": 202,
}  # fmt: skip
RECORD = 203  # Length of a record in i32
PLANES = {"cells": (2, "u8"), "weights": (8, "u2"), "bytes": (4, "u1"), "ints": (4, "i4"), "floats": (44, "f4")}
"""Work planes of a chunk: number and type of each."""


class Device(Protocol):
    """The part of a kernel backend that the codec uses."""

    threads: int
    """Work-items that run side by side as threads of a processor; 0 for a device without threads, such as a GPU."""

    def array(self, shape: tuple[int, ...], dtype: Any) -> Any:
        """A new array, not initialised."""

    def write(self, array: Any, values: np.ndarray, offset: int = 0) -> None:
        """Copy values into an array, from element `offset` on."""

    def read(self, array: Any, out: np.ndarray | None = None, offset: int = 0) -> np.ndarray:
        """Copy an array, or a part of it from element `offset` on, to the host."""

    def launch(self, name: str, size: tuple[int, ...], *args: Any) -> None:
        """Run a kernel with so many work-items."""


class DeviceArrays:
    """Arrays on a device, by name."""

    def __init__(self, device: Device) -> None:
        self.device = device
        self._arrays: dict[str, Any] = {}

    def _array(self, name: str, shape: tuple[int, ...], dtype: Any) -> Any:
        if name not in self._arrays:
            self._arrays[name] = self.device.array(shape, dtype)
        return self._arrays[name]

    def close(self) -> None:
        """Free the arrays on the device."""
        for array in self._arrays.values():
            array.release()
        self._arrays.clear()


def launch_coding(
    device: Device,
    chunks: int,
    shape: tuple[int, int, int],  # elements of a plane, number of code planes, SH degree
    shared: Sequence[Any],  # arguments for both directions, in the kernel's order
    decoding: tuple[Sequence[int], Sequence[Any]] | None = None,
    counting: tuple[Sequence[int], Sequence[Any]] | None = None,
) -> None:
    """Run `code_chunks`, either to decode or to count.

    `decoding`, `counting`: numbers and arrays for the one direction to run.
    """
    # The kernel does not touch the arrays of the other direction, so any array may stand there.
    numbers, arrays = decoding or ([0] * 3, [shared[0]] * 4)
    more_numbers, more_arrays = counting or ([0] * 4, [shared[0]] * 5)
    device.launch(
        "code_chunks", (chunks,), int(counting is not None), *shape, *numbers, *more_numbers, *shared, *arrays, *more_arrays,
    )  # fmt: skip


def padded(rows: int) -> int:
    """Elements of a plane for so many rows, with room for vectors."""
    return -(-rows // 16) * 16 + _SPARE


def pack_group(record: np.ndarray, group: Group) -> None:
    """Write a group's fitted numbers into the record of its alphabet."""
    start = group.start
    record[PLACES["start"] : PLACES["symbols"]] = np.int64(start).astype(np.int32), start >> 32, group.shift
    sizes = [len(cut) for cut in group.cuts]
    record[PLACES["sizes"] : PLACES["mean cuts"]] = *sizes, group.kind.residual, group.kind.features
    for place, cuts in zip((PLACES["mean cuts"], PLACES["error cuts"]), group.cuts, strict=True):
        # A context is the number of cuts reached, so their order does not matter. The kernel starts at the lowest cut.
        record[place : place + len(cuts)] = np.sort(cuts)
    for place, weights in zip((PLACES["mean weights"], PLACES["error weights"]), group.weights, strict=True):
        record[place : place + len(weights)] = weights
