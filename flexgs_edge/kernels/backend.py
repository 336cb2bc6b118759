"""The one interface that the renderer drives: OpenCL kernels or their NumPy twins."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from flexgs_edge.memory.budget import MemoryBudget


@dataclass(frozen=True)
class KernelSpec:
    """How a kernel is found and launched.

    Parameters
    ----------
    file : str
        Name in `cl_kernels/`; `{form}` is `cpu` or `gpu`.
    signature : str
        One letter an argument: u uint32, i int32, f float32, b array.
    per : str
        What a work-item is: `rows` (a vector of W rows; the launch size counts rows), `item` (one of the launch
        size), `tile` (one item a tile on CPUs, a group of 256 on GPUs).
    stats : int, optional
        The blend's kind.
    widest : int
        Lanes of a vector at most.
    """

    file: str
    signature: str
    per: str = "item"
    stats: int | None = None
    widest: int = 16


_BLEND = "uuiiii" + "fff" + "bbbbb"

KERNELS: dict[str, KernelSpec] = {
    "activate": KernelSpec("activate.cl", "uibbbbb", "rows"),
    "project": KernelSpec("project.cl", "uuuiiibbbbbbbbb", "rows"),
    "sort_count_first": KernelSpec("sort.cl", "ubbbb"),
    "sort_scatter_first": KernelSpec("sort.cl", "ubbbb"),
    "sort_count": KernelSpec("sort.cl", "uubb"),
    "sort_scatter": KernelSpec("sort.cl", "uubbbbb"),
    "exclusive_scan": KernelSpec("sort.cl", "uub"),
    # Most splats are in no more than 8 block rows: with vectors of 16 their lists take a fifth longer.
    "tile_room": KernelSpec("tiles.cl", "uubbb", widest=8),
    "tile_count": KernelSpec("tiles.cl", "uuffibbbbb", widest=8),
    "tile_scatter": KernelSpec("tiles.cl", "ubbbb", widest=8),
    "blend": KernelSpec("blend_{form}.cl", _BLEND, "tile", stats=0),
    "blend_stats": KernelSpec("blend_{form}.cl", _BLEND + "bb", "tile", stats=1),
    "blend_removal": KernelSpec("blend_{form}.cl", _BLEND + "bb", "tile", stats=2),
    "blend_residual": KernelSpec("blend_{form}.cl", _BLEND + "bbb", "tile", stats=3),
    "blend_both": KernelSpec("blend_{form}.cl", _BLEND + "bbb", "tile", stats=4),
    "blend_backward": KernelSpec("blend_{form}.cl", _BLEND + "bbb", "tile", stats=5),
    "residual": KernelSpec("score.cl", "ubbb", "rows"),
    "sh_costs": KernelSpec("score.cl", "uuuuuubbbbb", "rows"),
    "sh_residual": KernelSpec("score.cl", "uuuuubbbb", "rows"),
    "ssim_columns": KernelSpec("similarity.cl", "uuubbbb", "rows"),
    "ssim_rows": KernelSpec("similarity.cl", "uubbb", "rows"),
    "project_backward": KernelSpec("backward.cl", "uuuuibbbbbbbbbbb", "rows"),
    "adam": KernelSpec("backward.cl", "uuffbbbbbbb", "rows"),
    "snap": KernelSpec("backward.cl", "uubbbbbbbb", "rows"),
    "dequantize": KernelSpec("dequantize.cl", "uuuuuuubbbb"),
}
"""Every kernel by the name that `Backend.launch` and the twins share."""

CODEC_KERNELS: dict[str, KernelSpec] = {
    "code_chunks": KernelSpec("code_chunks.cl", 11 * "u" + 17 * "b"),
    "encode_chunks": KernelSpec("encode_chunks.cl", "uubbbbbb"),
    "grid_rows": KernelSpec("grid_rows.cl", "uuuuuiiibbbb"),
}
"""Kernels that a codec launches; what they do in NumPy is the codec's own code, not a twin."""


class Array(Protocol):
    """An array in the backend's memory."""

    shape: tuple[int, ...]
    nbytes: int

    def release(self) -> None:
        """Free it."""


class Backend(Protocol):
    """Memory and kernels of one device (or of NumPy)."""

    name: str
    is_numpy: bool
    threads: int
    """Work-items that run side by side as threads of a processor do, with double precision; 0 where none do."""
    sort_blocks: int
    tile_blocks: int
    startup_seconds: float
    profile: defaultdict[str, float] | None

    @property
    def compile_seconds(self) -> float:
        """Seconds spent building kernels so far."""

    def describe(self) -> dict[str, Any]:
        """What runs the kernels, for `--json`."""

    def array(self, shape: tuple[int, ...], dtype: Any) -> Any:
        """An array, not initialised, taken from the budget."""

    def write(self, array: Any, values: np.ndarray, offset: int = 0) -> None:
        """Copy values into an array."""

    def mapped(self, array: Any) -> AbstractContextManager[np.ndarray]:
        """An array that is not empty on the host, to be written without a copy where the device shares the host's memory.

        What was in it may be gone; the device has what is in it at the end. Does not wait for kernels: none may use the array.
        """

    def mark(self) -> Callable[[], None]:
        """What waits for all kernels launched so far, and for none that is launched later."""

    def read(self, array: Any, out: np.ndarray | None = None, offset: int = 0) -> np.ndarray:
        """Copy an array out."""

    def fill(self, array: Any, value: int) -> None:
        """Set every element."""

    def launch(self, name: str, size: tuple[int, ...], *args: Any) -> None:
        """Run the kernel `name` over `size` rows, items or tiles."""

    def close(self) -> None:
        """Free what the backend holds."""


class HostArray:
    """An array of the NumPy backend."""

    def __init__(self, budget: MemoryBudget, shape: tuple[int, ...], dtype: Any) -> None:
        self.shape = shape
        self.nbytes = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
        self._budget = budget
        budget.take("an array", self.nbytes)
        self.data = np.zeros(shape, dtype)

    def release(self) -> None:
        """Free the array (once)."""
        if self.nbytes >= 0:
            self._budget.give(self.nbytes)
            self.nbytes = -1
            del self.data


class TwinBackend:
    """The NumPy twins: the specification, and the way to run where no OpenCL device works."""

    name = "numpy"
    is_numpy = True
    threads = 0
    sort_blocks = 4
    tile_blocks = 4

    def __init__(self, budget: MemoryBudget) -> None:
        start = time.perf_counter()
        from flexgs_edge.kernels.twins import TWINS

        self._twins: dict[str, Callable[..., None]] = TWINS
        self.budget = budget
        self.profile: defaultdict[str, float] | None = None
        self.startup_seconds = time.perf_counter() - start
        self.compile_seconds = 0.0

    def describe(self) -> dict[str, Any]:
        """What runs the kernels."""
        return {"backend": "numpy", "numpy": np.__version__}

    def array(self, shape: tuple[int, ...], dtype: Any) -> HostArray:
        """An array taken from the budget."""
        return HostArray(self.budget, shape, dtype)

    def write(self, array: HostArray, values: np.ndarray, offset: int = 0) -> None:
        """Copy `values` to the flat element `offset` of `array`."""
        values = np.ascontiguousarray(values, array.data.dtype)
        array.data.reshape(-1)[offset : offset + values.size] = values.reshape(-1)

    def mapped(self, array: HostArray) -> AbstractContextManager[np.ndarray]:
        """The array itself."""
        return nullcontext(array.data)

    def mark(self) -> Callable[[], None]:
        """Kernels have run when `launch` returns."""
        return lambda: None

    def read(self, array: HostArray, out: np.ndarray | None = None, offset: int = 0) -> np.ndarray:
        """Copy `array` out, from the flat element `offset` on."""
        if out is None:
            return array.data.copy()
        out.reshape(-1)[:] = array.data.reshape(-1)[offset : offset + out.size]
        return out

    def fill(self, array: HostArray, value: int) -> None:
        """Set every element."""
        array.data.fill(value)

    def launch(self, name: str, size: tuple[int, ...], *args: Any) -> None:
        """Run the twin `name`."""
        start = time.perf_counter()
        with np.errstate(all="ignore"):  # kernels do not trap either: culling tests are written to fail on NaN
            self._twins[name](size, *(a.data if isinstance(a, HostArray) else a for a in args))
        if self.profile is not None:
            self.profile[name] += time.perf_counter() - start

    def close(self) -> None:
        """Nothing is held beyond the arrays."""
