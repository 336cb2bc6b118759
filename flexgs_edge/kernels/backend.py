"""The interface to kernels and memory: an OpenCL device, or the NumPy twins."""

import math
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from flexgs_edge.constants import SSIM_SIGMA, SSIM_WINDOW
from flexgs_edge.memory.budget import MemoryBudget


@dataclass(frozen=True)
class KernelSpec:
    """Where a kernel is found, and how it is launched."""

    file: str  # name in `cl_kernels/`; `{form}` is `cpu` or `gpu`
    signature: str  # one letter for each argument: u uint32, i int32, f float32, b array
    # The work of one item: `rows` (a vector of W rows; the launch size counts rows), `span` (`ROW_SPAN` elements of a
    # picture's row on CPUs, a vector on GPUs; the launch size counts elements), `item` (one of the launch size), `tile`
    # (one work-item a tile on CPUs, a group of 256 on GPUs), `block` (one work-item a block of splats on CPUs, a group
    # on GPUs), `group` (one work-item on CPUs, one group on GPUs).
    per: str = "item"
    stats: int | None = None  # kind of statistics, for blends
    widest: int = 16  # most lanes of a vector


_BLEND = "uuiiii" + "fff" + "bbbbb"

KERNELS: dict[str, KernelSpec] = {
    "activate": KernelSpec("activate.cl", "uibbbbb", "rows"),
    "project": KernelSpec("project.cl", "uuuuiibbbbbbbbbb", "rows"),
    "sort_count_first": KernelSpec("sort.cl", "ubbbb"),
    "sort_scatter_first": KernelSpec("sort.cl", "ubbbb"),
    "sort_count": KernelSpec("sort.cl", "uubb"),
    "sort_scatter": KernelSpec("sort.cl", "uubbbbb"),
    "exclusive_scan": KernelSpec("sort.cl", "uub", "group"),
    # Most splats touch at most 8 block rows, so vectors of 16 would be slower.
    "tile_room": KernelSpec("tiles.cl", "uubbb", widest=8),
    "tile_count": KernelSpec("tiles.cl", "uuffbbbbb", "block", widest=8),
    "tile_scatter": KernelSpec("tiles.cl", "ubbbb", "block", widest=8),
    "blend": KernelSpec("blend_{form}.cl", _BLEND, "tile", stats=0),
    "blend_stats": KernelSpec("blend_{form}.cl", _BLEND + "bb", "tile", stats=1),
    "blend_removal": KernelSpec("blend_{form}.cl", _BLEND + "bb", "tile", stats=2),
    "blend_residual": KernelSpec("blend_{form}.cl", _BLEND + "bbb", "tile", stats=3),
    "blend_both": KernelSpec("blend_{form}.cl", _BLEND + "bbb", "tile", stats=4),
    "blend_backward": KernelSpec("blend_{form}.cl", _BLEND + "bbb", "tile", stats=5),
    "residual": KernelSpec("score.cl", "ubbb", "rows"),
    "add_costs": KernelSpec("score.cl", "uuuuuuubbbbbb", "rows"),
    "sh_residual": KernelSpec("score.cl", "uuuuuubbbbb", "rows"),
    "ssim_columns": KernelSpec("similarity.cl", "uuubbbb", "rows"),
    "ssim_rows": KernelSpec("similarity.cl", "uubbb", "rows"),
    "flip_colours": KernelSpec("flip.cl", "uub", "rows"),
    "flip_columns": KernelSpec("flip.cl", "uuuubbb", "rows"),
    "flip_rows": KernelSpec("flip.cl", "uubbb", "rows"),
    "flip_pair": KernelSpec("flip.cl", "ubbb", "rows"),
    "dssim_slopes": KernelSpec("similarity.cl", "uuuuuuubbbb", "span"),
    "dssim_residual": KernelSpec("similarity.cl", "uuuuufubbbbb", "span"),
    "project_backward": KernelSpec("backward.cl", "uuuuifbbbbbbbbbbb", "rows"),
    "descend": KernelSpec("descend.cl", "uuuiiifff" + 19 * "b", "rows"),
    "follow": KernelSpec("descend.cl", "uufbb", "rows"),
    "snap": KernelSpec("descend.cl", "uubbbbbbbb", "rows"),
    "dequantize": KernelSpec("dequantize.cl", "uuuuuuubbbb"),
}  # Every kernel, by the name that `Backend.launch` and the twins use

CODEC_KERNELS: dict[str, KernelSpec] = {
    "code_chunks": KernelSpec("code_chunks.cl", 11 * "u" + 17 * "b"),
    "encode_chunks": KernelSpec("encode_chunks.cl", "uubbbbbb"),
    "grid_rows": KernelSpec("grid_rows.cl", "uuuuuiiibbbb"),
}  # Kernels of the codec. They have no twins: the codec's own NumPy code is their specification.


class Array(Protocol):
    """An array in the backend's memory."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    nbytes: int

    def release(self) -> None:
        """Free the array."""


class Backend(Protocol):
    """Memory and kernels of one device, or of NumPy."""

    name: str
    is_numpy: bool
    threads: int
    """Work-items that run side by side as threads of a processor with f64; 0 for a device without them, such as a GPU."""
    sort_blocks: int
    tile_blocks: int
    most_pairs: int
    """Most pairs of splats and tiles that the device may list at once, unless the view has more tiles; 0: any number."""
    startup_seconds: float
    profile: defaultdict[str, float] | None

    @property
    def compile_seconds(self) -> float:
        """Seconds spent on building kernels so far."""

    def describe(self) -> dict[str, Any]:
        """The device and its settings, for `--json`."""

    def array(self, shape: tuple[int, ...], dtype: Any) -> Any:
        """A new array, not initialised; its bytes are taken from the budget."""

    def write(self, array: Any, values: np.ndarray, offset: int = 0, stays: bool = False) -> None:
        """Copy values into an array, from the flat element `offset` on.

        With `stays`, the caller does not change them any more, so that the device may read them later.
        """

    def mapped(self, array: Any) -> AbstractContextManager[np.ndarray]:
        """Write to an array on the host, without a copy if the device shares the host's memory.

        The array may not be empty. The old values may be lost, and the device gets the new ones at the end. This does
        not wait for kernels, so none may use the array.
        """

    def mark(self) -> Callable[[], None]:
        """A function that waits for all kernels launched so far, but for none launched later."""

    def read(self, array: Any, out: np.ndarray | None = None, offset: int = 0, waits: bool = True) -> np.ndarray:
        """Copy an array to the host, from the flat element `offset` on.

        Without `waits`, the values are there only when a later read that waits returns.
        """

    def fill(self, array: Any, value: int, count: int | None = None) -> None:
        """Set every element of an array, or the first `count` of its rows."""

    def launch(self, name: str, size: tuple[int, ...], *args: Any) -> None:
        """Run the kernel `name` over `size` rows, items or tiles."""

    def close(self) -> None:
        """Free all that the backend holds."""


class HostArray:
    """An array of the NumPy backend."""

    def __init__(self, budget: MemoryBudget, shape: tuple[int, ...], dtype: Any) -> None:
        self.shape = shape
        self.dtype = np.dtype(dtype)
        self.nbytes = math.prod(map(int, shape)) * self.dtype.itemsize
        self._budget = budget
        budget.take("an array", self.nbytes)
        self.data = np.zeros(shape, dtype)

    def release(self) -> None:
        if self.nbytes >= 0:
            self._budget.give(self.nbytes)
            self.nbytes = -1
            del self.data


class TwinBackend:
    """Runs the NumPy twins, which specify the kernels; slow, but it needs no OpenCL device."""

    name = "numpy"
    is_numpy = True
    threads = 0
    sort_blocks = 4
    tile_blocks = 4
    most_pairs = 0

    def __init__(self, budget: MemoryBudget) -> None:
        start = time.perf_counter()
        from flexgs_edge.kernels.twins import TWINS

        self._twins: dict[str, Callable[..., None]] = TWINS
        self.budget = budget
        self.profile: defaultdict[str, float] | None = None
        self.startup_seconds = time.perf_counter() - start
        self.compile_seconds = 0.0

    def describe(self) -> dict[str, Any]:
        return {"backend": "numpy", "numpy": np.__version__}

    def array(self, shape: tuple[int, ...], dtype: Any) -> HostArray:
        return HostArray(self.budget, shape, dtype)

    def write(self, array: HostArray, values: np.ndarray, offset: int = 0, stays: bool = False) -> None:
        values = np.ascontiguousarray(values, array.data.dtype)
        array.data.reshape(-1)[offset : offset + values.size] = values.reshape(-1)

    def mapped(self, array: HostArray) -> AbstractContextManager[np.ndarray]:
        return nullcontext(array.data)

    def mark(self) -> Callable[[], None]:
        return lambda: None  # `launch` returns when the twin has run

    def read(self, array: HostArray, out: np.ndarray | None = None, offset: int = 0, waits: bool = True) -> np.ndarray:
        if out is None:
            return array.data.copy()
        out.reshape(-1)[:] = array.data.reshape(-1)[offset : offset + out.size]
        return out

    def fill(self, array: HostArray, value: int, count: int | None = None) -> None:
        array.data[:count].fill(value)

    def launch(self, name: str, size: tuple[int, ...], *args: Any) -> None:
        start = time.perf_counter()
        with np.errstate(all="ignore"):  # kernels do not trap either; culling tests are written to fail on NaN
            self._twins[name](size, *(a.data if isinstance(a, HostArray) else a for a in args))
        if self.profile is not None:
            self.profile[name] += time.perf_counter() - start

    def close(self) -> None:
        """Do nothing: the backend holds only arrays."""


def window(step: int = 1) -> np.ndarray:
    """[n] f32, the weights of the Gaussian window, with the sum 1.

    `step`: pixels from one row and column of a sampled picture to the next. The window covers the same part of the
    whole picture: n is `SSIM_WINDOW` at step 1, and at least 3.
    """
    reach = max(SSIM_WINDOW // 2 // step, 1)
    away = np.arange(-reach, reach + 1) * step
    taps = np.exp(-0.5 * np.square(away / SSIM_SIGMA))
    return (taps / taps.sum()).astype(np.float32)
