"""The OpenCL backend: build the kernels for one device, and launch them by name."""

import math
import time
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pyopencl as cl

from flexgs_edge.constants import LANES, ROW_SPAN
from flexgs_edge.errors import BudgetError, DeviceError
from flexgs_edge.kernels.backend import CODEC_KERNELS, KERNELS
from flexgs_edge.kernels.choose_device import GPU_WIDTHS, WIDTHS, DeviceInfo, Form, likely_form, native_width
from flexgs_edge.kernels.cl_sources import load_source
from flexgs_edge.memory.budget import MemoryBudget

LIMITED_BLOCKS = 16
"""Work-items of the serial passes. More would make the scans of their counts longer, which one work-item does."""
STEPS_A_PAIR = 24
"""Steps that a pair of splat and tile may take. A blend of the GPU form takes 17 where the compiler leaves its sums a loop;
`tile_count` takes 7.25: the splat, its row of tiles (1.25), the four block rows of that, the tile."""
_DIGITS = 2048
SCAN_GROUPS = (1024, 256, 64)  # Sizes of the work-group that scans on GPUs: the largest that the device allows
LIST_GROUP = 64  # Size of the work-groups that list pairs on GPUs
GPU_BLOCKS = (64, 256)
"""Least and most work-items of the serial passes on GPUs; between them, two for each compute unit."""
_CONTEXTS: dict[int, cl.Context] = {}  # By device
_PROGRAMS: dict[tuple[int, str, tuple[str, ...]], tuple[cl.Context, cl.Program]] = {}
"""By context, source and options. Each keeps its context, so that no other one takes its number."""
SCALARS = {"u": np.uint32, "i": np.int32, "f": np.float32, "b": None}
FILLED_TOGETHER = (16, 8, 4, 2)
"""Elements of a pattern that fills an array, where its size allows. Patterns have at most 128 bytes."""
SMALL_WRITE = 1 << 16  # Most bytes of a write that does not wait for the queue: docs/results/tuning.md#small_write
HELD_WRITE = 1 << 22
"""Most bytes of values that stay, which a write holds on to without waiting. The budget does not count them:
docs/results/tuning.md#one_pass"""


def context_of(device: cl.Device) -> cl.Context:
    """The context of `device`; raises `cl.Error`."""
    if device.int_ptr not in _CONTEXTS:
        _CONTEXTS[device.int_ptr] = cl.Context([device])
    return _CONTEXTS[device.int_ptr]


def built_program(context: cl.Context, source: str, options: tuple[str, ...]) -> tuple[cl.Program, float]:
    """The program of `source`, built with `options`, and the seconds that building took: 0 if this process had it.

    Raises `cl.Error` if it does not build.
    """
    key, seconds = (context.int_ptr, source, options), 0.0
    if key not in _PROGRAMS:
        start = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # CompilerWarning on any build log, such as PoCL's remarks
            built = cl.Program(context, source).build(options=["-cl-std=CL1.2", *options], cache_dir=False)  # type: ignore[arg-type]
        _PROGRAMS[key], seconds = (context, built), time.perf_counter() - start
    return _PROGRAMS[key][1], seconds


class DeviceArray:
    """A buffer on the device, with the shape and dtype of its array."""

    def __init__(self, backend: "OpenCLBackend", shape: tuple[int, ...], dtype: Any) -> None:
        self.shape = shape
        self.dtype = np.dtype(dtype)
        self.nbytes = math.prod(map(int, shape)) * self.dtype.itemsize
        self.changed: cl.Event | None = None
        """The last fill, or write or read that nobody waited for, which may not have begun. It holds on to its values, and is
        waited for when another event takes its place."""
        self._backend = backend
        backend.budget.take("a device buffer", self.nbytes)
        try:
            # OpenCL does not allow buffers of size zero; nobody reads the spare bytes.
            self.buffer = cl.Buffer(backend.context, cl.mem_flags.READ_WRITE, max(self.nbytes, 16))
        except (cl.MemoryError, cl.LogicError) as error:
            backend.budget.give(self.nbytes)
            raise BudgetError(
                f"the device refused a buffer of {self.nbytes} bytes ({error}); it allows "
                f"{backend.info.max_alloc_bytes} a buffer: use a smaller --memory-limit, so that chunks get smaller"
            ) from error

    def release(self) -> None:
        if self.nbytes >= 0:
            self.buffer.release()
            self._backend.budget.give(self.nbytes)
            self.nbytes = -1


def steps_of(name: str, size: tuple[int, ...], args: tuple[Any, ...]) -> int:
    """Steps of the longest work-item of the passes whose steps grow with the scene or the view; 0 for other kernels."""
    if name == "exclusive_scan":
        cells, blocks = args[:2]
        # More than the scan of one work-group takes: a list has room for one pair a tile, and a blend takes all in one tile.
        return int(cells * (blocks + 2))
    if name.startswith("sort_"):
        return int(args[0] // size[0] + _DIGITS)
    return 0


def check_steps(info: DeviceInfo, name: str, size: tuple[int, ...], args: tuple[Any, ...]) -> None:
    """Refuse a launch whose loops the device would leave early, since its results would be wrong.

    Raises `DeviceError` with what to do.
    """
    steps = steps_of(name, size, args)
    if steps > info.loop_steps:
        what = "views of fewer pixels" if name == "exclusive_scan" and args[0] != _DIGITS else "a smaller scene"
        raise DeviceError(
            f"{info.name} ({info.platform}) leaves loops after {info.loop_steps} steps, and {name} needs {steps}: "
            f"use another device, or {what}"
        )


class OpenCLBackend:
    """Kernels and memory of one OpenCL device: context, in-order queue, kernels and buffers."""

    is_numpy = False

    def __init__(
        self,
        info: DeviceInfo,  # the device
        budget: MemoryBudget,  # counts all buffers
        width: int | None = None,  # lanes of a vector: 16, 8, 4 or 1; in the GPU form 4 or 1
        form: str | None = None,  # form of the blend kernel: one work-item a tile, or one work-group a tile
        written_fma: bool | None = None,  # whether `fma` is written out
    ) -> None:
        start = time.perf_counter()
        self.info = info
        self.budget = budget
        assert info.handle is not None
        try:
            self.context = info.context or context_of(info.handle)
            self.queue = cl.CommandQueue(self.context)
            # A queue of its own: writing to an array that no kernel uses must not wait for other kernels.
            self._maps = cl.CommandQueue(self.context)
        except cl.Error as error:
            raise DeviceError(
                f"{info.name} ({info.platform}) does not open ({error}): it is gone, or its driver is broken; "
                "`flexgs-edge devices` shows what is there"
            ) from error
        self.compile_seconds = 0.0  # spent on building programs so far
        # Wall seconds by kernel; None (default) if not measured. Measuring makes every launch wait for the queue.
        self.profile: defaultdict[str, float] | None = None
        chosen = Form.named(info.form) or likely_form(info)
        if form is not None and form != chosen.kind:
            chosen = replace(chosen, kind=form, width=1 if form == "gpu" else native_width(info))
        self.form, self.width = chosen.kind, width or chosen.width
        self.written_fma = chosen.written_fma if written_fma is None else written_fma
        widths = GPU_WIDTHS if self.form == "gpu" else WIDTHS
        if self.width not in widths:
            expected = ", ".join(map(str, widths))
            raise DeviceError(f"vector width {self.width} of the {self.form} form: expected one of {expected}")
        self.name = f"{info.name} ({info.platform})"
        # OpenCL does not ask for rounded quotients and roots: docs/devices.md#quotients-and-roots
        offers = cl.device_fp_config.CORRECTLY_ROUNDED_DIVIDE_SQRT
        rounds = info.handle is not None and info.handle.single_fp_config & offers
        self._options = ("-cl-fp32-correctly-rounded-divide-sqrt",) if rounds else ()
        # Hints and conversions that are not OpenCL C: only PoCL's compiler is known to take them, and only it gains by them.
        self._builtins = "portable computing" in info.platform.lower()
        # Blocks of the serial passes: enough to keep all compute units busy, few enough for short scans.
        least, most = GPU_BLOCKS
        gpu_blocks = min(max(2 * info.compute_units, least), most)
        self.sort_blocks = self.tile_blocks = max(4 * info.compute_units, 16) if self.form == "cpu" else gpu_blocks
        self._scan_group = next((size for size in SCAN_GROUPS if size <= info.max_work_group), 1)
        self.most_pairs = 0
        if info.loop_steps:
            self.sort_blocks = self.tile_blocks = LIMITED_BLOCKS
            self.most_pairs = info.loop_steps // STEPS_A_PAIR
        # The codec's kernels take f64, and join two numbers in one of twice the width, which needs little endian.
        able = info.handle is not None and info.handle.double_fp_config != 0 and info.handle.endian_little
        self.threads = info.compute_units if self.form == "cpu" and able and not info.loop_steps else 0
        self._kernels: dict[str, cl.Kernel] = {}
        self.startup_seconds = time.perf_counter() - start

    def describe(self) -> dict[str, Any]:
        return {"backend": "opencl", **self.info.to_json(), "width": self.width, "form": self.form}

    def launch(self, name: str, size: tuple[int, ...], *args: Any) -> None:
        spec = KERNELS.get(name) or CODEC_KERNELS[name]
        if name not in self._kernels:
            options = [f"-DW={min(self.width, spec.widest)}", *self._options]
            if self.form == "gpu":
                options += [f"-DGROUP={self._scan_group}", f"-DLIST_GROUP={LIST_GROUP}"]
            if self.written_fma:
                options.append("-DWRITTEN_FMA")
            if self._builtins:
                options.append("-DCLANG_BUILTINS")
            source = load_source(spec.file.format(form=self.form), spec.stats, self.form)
            self._kernels[name] = self.kernel(source, name, tuple(options), spec.signature)
        local: tuple[int, ...] = (1,) * len(size)
        if spec.per == "span" and self.form == "cpu":
            size = (size[0] // ROW_SPAN,)
        elif spec.per in ("rows", "span"):
            # LANES // width vectors are a whole group in any array, on all devices.
            size, local = (size[0] // self.width,), (LANES // self.width,)
        elif spec.per == "tile" and self.form == "gpu":
            size, local = (size[0] * 256 // self.width,), (256 // self.width,)
        elif spec.per == "block" and self.form == "gpu":
            size, local = (size[0] * LIST_GROUP,), (LIST_GROUP,)
        elif spec.per == "group" and self.form == "gpu":
            size = local = (self._scan_group,)
        if self.info.loop_steps:
            check_steps(self.info, name, size, args)
        if size[0]:
            self.enqueue(name, self._kernels[name], size, local, args)

    def kernel(self, source: str, name: str, options: tuple[str, ...], signature: str) -> cl.Kernel:
        """The kernel `name` of `source`, built with `options`; `signature` has one letter (u i f b) for each argument.

        Raises `DeviceError` if the program does not build; the message has the device, the options and the compiler's words.
        """
        try:
            program, seconds = built_program(self.context, source, options)
        except cl.Error as error:
            device = f"{self.info.name} ({self.info.platform})"
            raise DeviceError(f"kernel {name} does not build on {device} with {' '.join(options)}:\n{error}") from error
        self.compile_seconds += seconds
        kernel = cl.Kernel(program, name)
        kernel.set_scalar_arg_dtypes([SCALARS[kind] for kind in signature])
        return kernel

    def enqueue(
        self, label: str, kernel: cl.Kernel, size: tuple[int, ...], local: tuple[int, ...], args: tuple[Any, ...]
    ) -> None:
        """Enqueue `kernel`; with `profile` set, also wait for it, and add its wall seconds under `label`."""
        start = time.perf_counter() if self.profile is not None else 0.0
        try:
            kernel(self.queue, size, local, *[a.buffer if type(a) is DeviceArray else a for a in args])
        except cl.Error as error:
            raise self._failure(f"running kernel {label}", error) from error
        if self.profile is not None:
            self.queue.finish()
            self.profile[label] += time.perf_counter() - start

    def _failure(self, task: str, error: cl.Error) -> BudgetError | DeviceError:
        """What a runtime says when its device fails, as an error that a user understands."""
        device = f"{self.info.name} ({self.info.platform})"
        if isinstance(error, cl.MemoryError):
            return BudgetError(f"{device} ran out of memory while {task} ({error}): use a smaller --memory-limit")
        return DeviceError(
            f"{device} failed while {task} ({error}): it is gone, or its driver is broken; "
            "`flexgs-edge devices --self-test` tests it"
        )

    def array(self, shape: tuple[int, ...], dtype: Any) -> DeviceArray:
        return DeviceArray(self, shape, dtype)

    def write(self, array: DeviceArray, values: np.ndarray, offset: int = 0, stays: bool = False) -> None:
        values = np.ascontiguousarray(values, array.dtype)
        if values.size:
            # What is small is copied here, so that the host need not wait for all kernels before.
            small, at = values.nbytes <= SMALL_WRITE, offset * array.dtype.itemsize
            waits = not small and not (stays and values.nbytes <= HELD_WRITE)
            copied = values.copy() if small and not stays else values
            try:
                written = cl.enqueue_copy(self.queue, array.buffer, copied, dst_offset=at, is_blocking=waits)
            except cl.Error as error:
                raise self._failure("writing an array", error) from error
            array.changed = None if waits else written

    @contextmanager
    def mapped(self, array: DeviceArray) -> Iterator[np.ndarray]:
        if array.changed is not None:
            array.changed.wait()
        flags = cl.map_flags.WRITE_INVALIDATE_REGION
        values, _ = cl.enqueue_map_buffer(self._maps, array.buffer, flags, 0, array.shape, array.dtype)
        try:
            yield values
        finally:
            values.base.release(self._maps).wait()

    def mark(self) -> Callable[[], None]:
        marker: cl.Event = cl.enqueue_marker(self.queue)
        self.queue.flush()
        return marker.wait

    def read(
        self, array: DeviceArray, out: np.ndarray | None = None, offset: int = 0, waits: bool = True
    ) -> np.ndarray:
        out = np.empty(array.shape, array.dtype) if out is None else out
        if out.size:
            at = offset * array.dtype.itemsize
            try:
                copied = cl.enqueue_copy(self.queue, out, array.buffer, src_offset=at, is_blocking=waits)
            except cl.Error as error:
                raise self._failure("reading an array", error) from error
            if not waits:
                array.changed = copied
        return out

    def fill(self, array: DeviceArray, value: int, count: int | None = None) -> None:
        size = array.nbytes if count is None else array.nbytes // max(array.shape[0], 1) * count
        # A runtime copies the pattern again and again, so a long one is faster.
        repeats = next((n for n in FILLED_TOGETHER if size % (n * array.dtype.itemsize) == 0), 1)
        if size:
            pattern = np.full(repeats, value, array.dtype)
            array.changed = cl.enqueue_fill_buffer(self.queue, array.buffer, pattern, 0, size)

    def close(self) -> None:
        """Wait for everything that is enqueued; the owners of buffers release them."""
        self.queue.finish()
