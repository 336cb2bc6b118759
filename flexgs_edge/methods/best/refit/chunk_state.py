"""The values of one chunk of a descent on the backend, and the kernels that move them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from flexgs_edge.kernels.backend import Backend
from flexgs_edge.render.chunks import Chunk
from flexgs_edge.scene.fields import FIELD

ORDER = ("means", "log_scales", "quats", "opacity_logits", "sh_dc", "sh_rest")
"""Fields in the order of a gradient's planes (cl_kernels/values.clh)."""
DECAYS = (0.9, 0.99)
"""Decay of Adam's running means of gradients and of their squares. The usual 0.999 of the second would remember longer than
a descent of a few hundred views lasts: docs/results/tuning.md#decays"""
WIDE = 0.055
"""A Gaussian whose largest deviation is above this share of its depth takes steps that are shorter by the same factor. Full
steps would make haze that no scored pose sees: docs/results/tuning.md#wide"""
PLANE_SETS = 5
"""How often all planes of a chunk are held: values and their mean, gradient, two running means of it."""


def widths(sh_degree: int) -> dict[str, int]:
    """How many planes each field has, in the order of `ORDER`."""
    return {name: FIELD[name].width(sh_degree) for name in ORDER}


class ChunkState:
    """Values of a chunk's rows, their mean, the last gradient, and Adam's running means of gradients.

    `chunk`: gets the values that views are drawn from. `antialiased`: as in `DeviceScene`.
    """

    def __init__(self, backend: Backend, chunk: Chunk, antialiased: bool) -> None:
        self.backend, self.chunk, self.antialiased = backend, chunk, int(antialiased)
        self.widths, self._arrays = widths(chunk.degree), []  # type: dict[str, int], list[Any]
        stride, self.planes = chunk.stride, sum(self.widths.values())
        try:
            self.values, self.gradient, self.first, self.second, self.mean = (
                self._array((self.planes, stride)) for _ in range(PLANE_SETS)
            )
            self.powers, self.pace = self._array((2, stride)), self._array((stride,))
            self.degrees = self._array((stride,), np.uint32)
            self.stored = [self._array((width, stride)) for width in (3, 4, 1)]
        except BaseException:
            self.release()
            raise

    def _array(self, shape: tuple[int, ...], dtype: Any = np.float32) -> Any:
        self._arrays.append(self.backend.array(shape, dtype))
        return self._arrays[-1]

    def begin(self) -> None:
        """Forget all steps so far."""
        for array in (self.first, self.second, self.mean):
            self.backend.fill(array, 0)
        self.backend.write(self.powers, np.ones(self.powers.shape, np.float32))

    def put_degrees(self, degrees: np.ndarray) -> None:
        """Set the SH degrees of the rows ([count] u8)."""
        own = np.zeros(self.chunk.stride, np.uint32)
        own[: self.chunk.count] = degrees
        self.backend.write(self.degrees, own)

    def snap(self, steps: Any) -> None:
        """Put the values on a grid (record of `step_record`), for drawing."""
        chunk, stride = self.chunk, self.chunk.stride
        self.backend.launch(
            "snap",
            (stride,),
            stride,
            chunk.degree,
            steps,
            self.values,
            chunk.means,
            *self.stored,
            chunk.sh_dc,
            chunk.sh_rest,
        )

    def activate(self) -> None:
        """Compute what else views are drawn from, after `snap`."""
        stride, chunk = self.chunk.stride, self.chunk
        self.backend.launch(
            "activate", (stride,), stride, self.antialiased, *self.stored, chunk.cov, chunk.log2_opacity
        )

    def differentiate(self, camera: Any, records: Any, sums: Any, base: int) -> None:
        """Gradients of the rows from a view's splats and their sums, where the chunk's first row is at `base`."""
        chunk = self.chunk
        self.backend.launch(
            "project_backward", (chunk.stride,), chunk.count, chunk.stride, base, chunk.degree, self.antialiased, WIDE,
            camera, chunk.means, *self.stored, chunk.sh_rest, self.degrees, records, sums, self.pace, self.gradient,
        )  # fmt: skip

    def step(self, rates: Any, steps: Any, prices: Any | None = None, share: float = 0.0) -> None:
        """Take one step of Adam, and put the values on a grid for drawing (records of `rate_record` and `step_record`).

        With `prices` (record of `bit_prices`), gradients count what bits cost. With a `share`, the mean follows.
        """
        chunk, stride = self.chunk, self.chunk.stride
        self.backend.launch(
            "descend", (stride,), stride, chunk.degree, self.planes, self.antialiased, int(prices is not None), int(share > 0),
            *DECAYS, share, rates, rates if prices is None else prices, steps, self.degrees, self.pace, self.gradient,
            self.powers, self.first, self.second, self.values, self.mean, chunk.means, *self.stored, chunk.sh_dc, chunk.sh_rest,
            chunk.cov, chunk.log2_opacity,
        )  # fmt: skip

    def follow(self, share: float) -> None:
        """Move the mean towards the values by `share`."""
        stride = self.chunk.stride
        self.backend.launch("follow", (stride,), stride, self.planes, share, self.values, self.mean)

    def settle(self) -> None:
        """Take the mean as the values."""
        stride = self.chunk.stride
        self.backend.launch("follow", (stride,), stride, self.planes, 1.0, self.mean, self.values)

    def release(self) -> None:
        """Free everything but the chunk."""
        for array in self._arrays:
            array.release()
        self._arrays = []


def fields_of(planes: dict[str, np.ndarray], own: dict[str, int]) -> Iterator[tuple[str, slice, np.ndarray]]:
    """Name, slice among all planes, and values of each field, as views. SH are cut to the first coefficients of each channel."""
    at = 0
    for name, width in own.items():
        values = planes[name]
        if name == "sh_rest":
            values = values.reshape(3, len(values) // 3, values.shape[1])[:, : width // 3]
        yield name, slice(at, at + width), values
        at += width
