"""Gradient descent on a device: all values of a scene move by Adam, one view a step."""

from __future__ import annotations

from typing import Any

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.constants import LANES
from flexgs_edge.errors import BudgetError
from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.methods.best.refit.chunk_state import PLANE_SETS, ChunkState, fields_of, widths
from flexgs_edge.methods.best.refit.prices import PRICES
from flexgs_edge.render.chunks import Chunk
from flexgs_edge.render.fit import GRADIENT_SUMS, sum_bytes
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.source import MemorySource
from flexgs_edge.units import format_mib

GRID_VALUES = 14
"""Step sizes that the kernel `snap` takes."""


def descent_bytes(sh_degree: int) -> int:
    """Bytes a row that a descent takes on the backend beside the scene.

    They hold the sums of a view; all planes five times (values and their mean, gradient, two running means of it); stored
    geometry, degrees, flags and powers.
    """
    return sum_bytes(GRADIENT_SUMS) + 4 * (PLANE_SETS * sum(widths(sh_degree).values()) + 8 + 4)


class Descent:
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
            lengths = sum(self.widths.values()), GRID_VALUES, PRICES
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
        part, span = (
            ChunkState(self.backend, chunk, self._scene.antialiased),
            slice(chunk.base, chunk.base + chunk.count),
        )
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

    def __enter__(self) -> Descent:
        return self

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
