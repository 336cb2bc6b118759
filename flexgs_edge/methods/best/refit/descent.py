"""Gradient descent on a device: all values of a scene move by Adam, one view a step."""

import math
from collections.abc import Iterator
from contextlib import AbstractContextManager
from typing import Any

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.constants import LANES
from flexgs_edge.errors import BudgetError
from flexgs_edge.grid.step_sizes import Planes, StepSizes
from flexgs_edge.kernels.backend import Backend
from flexgs_edge.memory.rows import read_ahead
from flexgs_edge.render.chunks import Chunk
from flexgs_edge.render.fit import GRADIENT_SUMS, sum_bytes
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource
from flexgs_edge.units import format_mib

WIDTH = 0.5
"""Prices rise over about this many grid steps around a centre. Within a step, it makes no difference to the bits."""
ORDER = ("means", "log_scales", "quats", "opacity_logits", "sh_dc", "sh_rest")
"""Fields in the order of a gradient's planes (cl_kernels/values.clh)."""
DECAYS = (0.9, 0.99)
"""Decay of Adam's running means of gradients and of their squares. The usual 0.999 of the second would remember longer than
a descent of a few hundred views lasts: docs/results/tuning.md#decays"""
WIDE = 0.055
"""A Gaussian whose largest deviation is above this share of its depth takes steps that are shorter by the same factor. Full
steps would make haze that no scored pose sees: docs/results/tuning.md#wide"""
PLANE_SETS = 5  # How often all planes of a chunk are held: values and their mean, gradient, two running means of it
GRID_VALUES, PRICE_VALUES = 14, 33  # Lengths of the records that the kernels `snap` and `descend` take


def bit_prices(planes: Planes, degrees: np.ndarray, steps: StepSizes, worth: float) -> np.ndarray:
    """The record of the kernel `descend`.

    `planes`: {field: [width, n] f32}, with n above 0, before the descent. Quaternions have their canonical form.
    `degrees`: [n] u8, SH degree kept for each row. `steps`: of the grid that the values will be put on. `worth`:
    squared error in one pose that a bit costs. Returns [33] f32: price and width of scale, rotation and opacity, and of
    luma and chroma of the constant and each SH degree; then centres of the three scales, opacity, Y, Co and Cg.
    """
    centres = _centres(planes)
    grid = [steps.scale, steps.rotation, steps.opacity]
    for luma in (steps.dc, *steps.sh):
        grid += [float(size) for size in steps.colour(luma)[:2]]
    sums, counts = np.zeros(len(grid)), np.zeros(len(grid))
    fields = (planes[name] for name in ("log_scales", "quats", "opacity_logits", "sh_dc", "sh_rest"))
    for rows, (scales, quats, logits, constant, rest) in read_ahead(len(degrees), *fields):
        colours, own = _luma_and_chroma(constant) - centres[4:, None], degrees[rows]
        kinds = [scales - centres[:3, None], quats[1:], logits - centres[3], colours[:1], colours[1:]]
        bands = rest.reshape(3, -1, len(own))
        for level in range(1, len(steps.sh) + 1):
            band = _luma_and_chroma(bands[:, level * level - 1 : (level + 1) ** 2 - 1, own >= level])
            kinds += [band[:1], band[1:]]
        sums += [np.abs(away).sum(dtype=np.float64) for away in kinds]
        counts += [away.size for away in kinds]
    # Where all values are alike they take no bits, and a small b must not make a large price of it.
    spreads = np.maximum(sums / np.maximum(counts, 1), np.array(grid) / 4)
    prices = np.zeros(PRICE_VALUES, np.float32)
    prices[0 : 2 * len(grid) : 2] = worth / (math.log(2) * spreads)
    prices[1 : 2 * len(grid) : 2] = WIDTH * np.array(grid)
    prices[-len(centres) :] = centres
    return prices


def _centres(planes: Planes) -> np.ndarray:
    """[7] f64, medians of the three scales, opacity, Y, Co and Cg. Memory holds one column at a time."""

    def median(name: str, place: int) -> float:
        column = np.empty(planes[name].shape[1])
        for rows, (part,) in read_ahead(len(column), planes[name]):
            column[rows] = (_luma_and_chroma(part) if name == "sh_dc" else part)[place]
        return float(np.median(column, overwrite_input=True))

    scales, colours = ([median(name, place) for place in range(3)] for name in ("log_scales", "sh_dc"))
    return np.array([*scales, median("opacity_logits", 0), *colours])


def _luma_and_chroma(colours: np.ndarray) -> np.ndarray:
    """Y, Co and Cg ([3, ...] f64) of red, green and blue."""
    red, green, blue = colours.astype(np.float64)
    return np.stack([(red + 2 * green + blue) / 4, red - blue, green - (red + blue) / 2])


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
        chunk, size = self.chunk, (self.chunk.stride,)
        planes = self.values, chunk.means, *self.stored, chunk.sh_dc, chunk.sh_rest
        self.backend.launch("snap", size, chunk.stride, chunk.degree, steps, *planes)

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


def descent_bytes(sh_degree: int) -> int:
    """Bytes a row that a descent takes on the backend beside the scene.

    They hold the sums of a view; all planes five times (values and their mean, gradient, two running means of it); stored
    geometry, degrees, flags and powers.
    """
    return sum_bytes(GRADIENT_SUMS) + 4 * (PLANE_SETS * sum(widths(sh_degree).values()) + 8 + 4)


class Descent(AbstractContextManager["Descent"]):
    """Values of a scene, their gradients, and Adam's running means of these.

    After `put_on`, views are drawn from values rounded to their grids, but gradients move the values themselves (the
    straight-through rule). Neighbours then compensate for errors of rounding, too.

    Raises `BudgetError` when the scene, its gradients and their running means do not fit at once. `StreamedDescent`
    goes on there.
    """

    def __init__(
        self,
        renderer: Renderer,  # with nothing loaded
        planes: dict[str, np.ndarray],  # stored planes ([width, n] f32 by field); not changed
        degrees: np.ndarray,  # [n] u8, SH degree of each row. Coefficients above it stay as they are.
        origin: np.ndarray,  # [3] f64, as in `SceneSource`
        camera: Camera,  # the largest view, from which memory is planned
        structure: float = 0.0,  # weight of the structural term of the loss (`Renderer.gradient_sums`)
    ) -> None:
        self.renderer, self.backend, self.structure = renderer, renderer.backend, structure
        source = MemorySource(planes, origin=origin, sh_count=int(np.flatnonzero(degrees).max(initial=-1)) + 1)
        self.count, self.widths = source.count, widths(source.sh_degree)
        self._parts: list[ChunkState] = []
        self._arrays: list[Any] = []
        self._priced = False
        # Planes of the last chunk with SH and of the last without are padded.
        size = descent_bytes(source.sh_degree) * (self.count + 2 * LANES)
        self._scene = renderer.load(source, -(-size // max(self.count, 1)), references=True, structure=structure > 0)
        try:
            renderer.render_planes(self._scene, camera)
            if not self._scene.resident:
                raise BudgetError(
                    f"distilling {source.count} Gaussians keeps all of them in memory at once with what their steps remember "
                    f"({format_mib(size)}), more than the memory limit leaves: use a larger --memory-limit, or --distil 0"
                )
            self._scene.stay()
            lengths = sum(self.widths.values()), GRID_VALUES, PRICE_VALUES
            self._rates, self._steps, self._prices = (self._array((n,)) for n in lengths)
            for chunk in self._scene.chunks():
                self._parts.append(self._state(chunk, planes, degrees))
            self.put_on(None)
        except BaseException:
            self.close()
            raise

    def _array(self, shape: tuple[int, ...]) -> Any:
        self._arrays.append(self.backend.array(shape, np.float32))
        return self._arrays[-1]

    def _state(self, chunk: Chunk, planes: dict[str, np.ndarray], degrees: np.ndarray) -> ChunkState:
        part = ChunkState(self.backend, chunk, self._scene.antialiased)
        span = slice(chunk.base, chunk.base + chunk.count)
        self.backend.fill(part.values, 0)
        part.begin()
        part.put_degrees(degrees[span])
        for _, rows, own in fields_of(planes, part.widths):
            values = own[..., span].reshape(rows.stop - rows.start, chunk.count)
            for plane in range(rows.start, rows.stop):
                self.backend.write(part.values, values[plane - rows.start], plane * chunk.stride)
        return part

    def put_on(self, steps: StepSizes | None) -> None:
        """From now on, draw from values on this grid (None: from the values themselves)."""
        self.backend.write(self._steps, step_record(steps))
        for part in self._parts:
            part.snap(self._steps)
            part.activate()

    def price(self, prices: np.ndarray) -> None:
        """From now on, steps also go down what bits cost (record of `bit_prices`)."""
        self.backend.write(self._prices, prices)
        self._priced = True

    def differentiate(self, camera: Camera, target: np.ndarray) -> None:
        """Compute gradients of the loss of a view against `target` ([3, H, W] f16, as for `Renderer.residual_sums`)."""
        sums = self.renderer.gradient_sums(self._scene, camera, target, self.structure)
        for part in self._parts:
            part.differentiate(self.renderer.camera_array, self.renderer.records_array, sums, part.chunk.base)

    def step(self, camera: Camera, target: np.ndarray, rates: dict[str, float], share: float = 0.0) -> None:
        """Take one step of Adam down the loss of a view; `rates` are the largest changes of each field's values.

        Then the running mean of the values moves towards them by `share`; 1 begins it anew.
        """
        self.differentiate(camera, target)
        self.backend.write(self._rates, rate_record(rates, self.widths))
        for part in self._parts:
            part.step(self._rates, self._steps, self._prices if self._priced else None, share)

    def settle(self) -> None:
        """Take the running mean as the values."""
        for part in self._parts:
            part.settle()

    def gradients(self) -> dict[str, np.ndarray]:
        """Gradients of the last view ([width, n] f32 by field), zero for rows that it does not show."""

        def read(part: ChunkState) -> np.ndarray:
            return np.where(self.backend.read(part.pace) > 0, self.backend.read(part.gradient), np.float32(0))

        return self._gathered(read)

    def planes(self) -> dict[str, np.ndarray]:
        """The values ([width, n] f32 by field), not rounded to any grid."""
        return self._gathered(lambda part: self.backend.read(part.values))

    def _gathered(self, read: Any) -> dict[str, np.ndarray]:
        whole = {name: np.zeros((width, self.count), np.float32) for name, width in self.widths.items()}
        for part in self._parts:
            values = read(part)
            for _, rows, own in fields_of(whole, part.widths):
                span = slice(part.chunk.base, part.chunk.base + part.chunk.count)
                own[..., span] = values[rows, : part.chunk.count].reshape(own[..., span].shape)
        return whole

    def close(self) -> None:
        """Free everything."""
        for part in self._parts:
            part.release()
        for array in self._arrays:
            array.release()
        self._parts, self._arrays = [], []
        self._scene.close()

    def __exit__(self, *exc: object) -> None:
        self.close()


def step_record(steps: StepSizes | None) -> np.ndarray:
    """[GRID_VALUES] f32, step sizes in the order of the kernel `snap`; zeros for None."""
    record = np.zeros(GRID_VALUES, np.float32)
    if steps is not None:
        record[:4] = steps.position, steps.scale, steps.rotation, steps.opacity
        for k, luma in enumerate((steps.dc, *steps.sh)):
            record[4 + 2 * k : 6 + 2 * k] = steps.colour(luma)[:2]
    return record


def rate_record(rates: dict[str, float], own: dict[str, int]) -> np.ndarray:
    """[planes] f32, the rate of each plane."""
    return np.concatenate([np.full(width, rates[name], np.float32) for name, width in own.items()])
