"""One OpenCL session: context, queue, kernels, and buffers counted in the budget."""

from __future__ import annotations

import math
import time
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pyopencl as cl

from flexgs_edge.errors import BudgetError, DeviceError
from flexgs_edge.kernels.choose_device import DeviceInfo
from flexgs_edge.memory.budget import MemoryBudget

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

    def __init__(self, session: Session, shape: tuple[int, ...], dtype: Any) -> None:
        self.shape = shape
        self.dtype = np.dtype(dtype)
        self.nbytes = math.prod(map(int, shape)) * self.dtype.itemsize
        self.changed: cl.Event | None = None
        """The last fill, or write or read that nobody waited for, which may not have begun. It holds on to its values, and is
        waited for when another event takes its place."""
        self._session = session
        session.budget.take("a device buffer", self.nbytes)
        try:
            # OpenCL does not allow buffers of size zero; nobody reads the spare bytes.
            self.buffer = cl.Buffer(session.context, cl.mem_flags.READ_WRITE, max(self.nbytes, 16))
        except (cl.MemoryError, cl.LogicError) as error:
            session.budget.give(self.nbytes)
            raise BudgetError(
                f"the device refused a buffer of {self.nbytes} bytes ({error}); it allows "
                f"{session.info.max_alloc_bytes} a buffer: use a smaller --memory-limit, so that chunks get smaller"
            ) from error

    def release(self) -> None:
        """Free the buffer (once)."""
        if self.nbytes >= 0:
            self.buffer.release()
            self._session.budget.give(self.nbytes)
            self.nbytes = -1


class Session:
    """Context, in-order queue, kernels and buffers of one device.

    `info`: from `choose_device`. `budget`: counts all buffers.
    """

    def __init__(self, info: DeviceInfo, budget: MemoryBudget) -> None:
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

    def kernel(self, source: str, name: str, options: tuple[str, ...], signature: str) -> cl.Kernel:
        """The kernel `name` of `source`, built with `options`; `signature` has one letter (u i f b) for each argument.

        Raises `DeviceError` if the program does not build; the message has the device, the options and the compiler's
        words.
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
            kernel(self.queue, size, local, *(a.buffer if isinstance(a, DeviceArray) else a for a in args))
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
        """A new array on the device, not initialised."""
        return DeviceArray(self, shape, dtype)

    def write(self, array: DeviceArray, values: np.ndarray, offset: int = 0, stays: bool = False) -> None:
        """Copy C-contiguous `values` to the flat element `offset` of `array`.

        They may change as soon as this returns, unless the caller says that they stay as they are.
        """
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
        """Map `array` to the host for writing. Its old values may be lost, and no kernel may use it meanwhile."""
        if array.changed is not None:
            array.changed.wait()
        flags = cl.map_flags.WRITE_INVALIDATE_REGION
        values, _ = cl.enqueue_map_buffer(self._maps, array.buffer, flags, 0, array.shape, array.dtype)
        try:
            yield values
        finally:
            values.base.release(self._maps).wait()

    def mark(self) -> Callable[[], None]:
        """A function that waits for everything enqueued so far."""
        marker: cl.Event = cl.enqueue_marker(self.queue)
        self.queue.flush()
        return marker.wait

    def read(
        self, array: DeviceArray, out: np.ndarray | None = None, offset: int = 0, waits: bool = True
    ) -> np.ndarray:
        """Copy `array` to the host, from the flat element `offset` on, as much as `out` holds; waits for the queue.

        If it does not wait, the values are there when a later read that waits returns.
        """
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
        """Set every element of `array` to `value`, or those of its first `count` rows."""
        size = array.nbytes if count is None else array.nbytes // max(array.shape[0], 1) * count
        # A runtime copies the pattern again and again, so a long one is faster.
        repeats = next((n for n in FILLED_TOGETHER if size % (n * array.dtype.itemsize) == 0), 1)
        if size:
            pattern = np.full(repeats, value, array.dtype)
            array.changed = cl.enqueue_fill_buffer(self.queue, array.buffer, pattern, 0, size)

    def close(self) -> None:
        """Wait for everything that is enqueued; the owners of buffers release them."""
        self.queue.finish()
