"""Backends for the kernel tests: every form of the kernels, and a backend that runs a kernel and its twin side by side."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np

from benchmarks.harness import read_sums
from flexgs_edge.cameras.auto import Drawing
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.kernels.backend import Backend, TwinBackend
from flexgs_edge.kernels.choose_device import DeviceInfo, Form, choose_device, list_devices
from flexgs_edge.kernels.opencl import OpenCLBackend
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.render.statistics import Statistics
from flexgs_edge.run.view_set import sketch
from flexgs_edge.scene.source import SceneSource

FORMS = ("w16", "w8", "w4", "w1", "gpu", "gpu4")
"""Forms of the OpenCL kernels: vector widths of the CPU form; the GPU form, and that with four pixels a work-item."""
ALL_FORMS = (*FORMS, "numpy")
GPU_FORMS = {"gpu": Form("gpu", 1), "gpu4": Form("gpu", 4), "fma": Form("gpu", 4, written_fma=True)}


def large_budget() -> MemoryBudget:
    """A budget that no test gets near."""
    return MemoryBudget(1 << 40)


@cache
def default_device() -> DeviceInfo:
    """The device that the tests run on; having none is a failure, not a skip."""
    return choose_device(None, list_devices())[0]


@cache
def open_form(form: str) -> Backend:
    """The backend of a form, built once for all tests."""
    if form == "numpy":
        return TwinBackend(large_budget())
    chosen = GPU_FORMS.get(form) or Form("cpu", int(form[1:]))
    return OpenCLBackend(replace(default_device(), form=str(chosen)), large_budget())


def drawing(form: str = "w16") -> Drawing:
    """What draws candidates for automatic views."""
    return partial(sketch, open_form(form), large_budget())


def draw(
    backend: Backend,
    source: SceneSource,
    camera: Camera,
    near: float = 0.2,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    antialiased: bool = False,
) -> np.ndarray:
    """One image ([H, W, 3] f32) of a scene that is loaded and freed for it."""
    renderer = Renderer(backend, large_budget(), near, background, antialiased)
    with renderer.load(source) as scene:
        image = renderer.render(scene, camera)
    renderer.release()
    return image


def count(
    backend: Backend, source: SceneSource, cameras: list[Camera], near: float = 0.2, antialiased: bool = False
) -> Statistics:
    """Statistics of a scene over views."""
    renderer = Renderer(backend, large_budget(), near, antialiased=antialiased)
    statistics = Statistics.zeros(source.count)
    with renderer.load(source) as scene:
        for camera in cameras:
            renderer.add_statistics(scene, camera, statistics)
    renderer.release()
    return statistics


def removal_costs(
    backend: Backend,
    source: SceneSource,
    camera: Camera,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    antialiased: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Squared error of removing each row, and its sum of squared weights, in one view ([N] i64, units of 1 / FIXED_ERROR)."""
    renderer = Renderer(backend, large_budget(), background=background, antialiased=antialiased)
    with renderer.load(source) as scene:
        errors, weights = read_sums(renderer, renderer.removal_sums(scene, camera), 2, source.count)
    renderer.release()
    return errors, weights


def residual_sums(backend: Backend, source: SceneSource, camera: Camera, target: np.ndarray) -> np.ndarray:
    """Weights, and weighted residual of red, green and blue ([4, N] i64, units of 1 / FIXED_WEIGHT) against [3, H, W] f16."""
    renderer = Renderer(backend, large_budget())
    with renderer.load(source) as scene:
        sums = read_sums(renderer, renderer.residual_sums(scene, camera, target), 4, source.count)
    renderer.release()
    return sums


def same_bits(one: np.ndarray, two: np.ndarray) -> bool:
    """Equal to the last bit, -0 and 0 told apart; any NaN equals any other."""
    if one.shape != two.shape or one.dtype != two.dtype:
        return False
    if one.dtype.kind == "f":
        kind = f"u{one.dtype.itemsize}"
        return bool(np.all((one.view(kind) == two.view(kind)) | (np.isnan(one) & np.isnan(two))))
    return bool(np.array_equal(one, two))


def launch(backend: Backend, name: str, size: tuple[int, ...], *args: Any) -> list[np.ndarray]:
    """Run one kernel on host arrays; returns all of its arrays as they are afterwards."""
    made = []
    plain = []
    for arg in args:
        if isinstance(arg, np.ndarray):
            array = backend.array(arg.shape, arg.dtype)
            backend.write(array, arg)
            made.append(array)
        plain.append(made[-1] if isinstance(arg, np.ndarray) else arg)
    backend.launch(name, size, *plain)
    after = [backend.read(array) for array in made]
    for array in made:
        array.release()
    return after


class _PairedArray:
    """One array on each of two backends."""

    def __init__(self, device: Any, host: Any, shape: tuple[int, ...], dtype: Any) -> None:
        self.device, self.host, self.shape, self.dtype = device, host, shape, np.dtype(dtype)
        self.nbytes = host.nbytes

    def release(self) -> None:
        """Free both."""
        self.device.release()
        self.host.release()


class PairedBackend:
    """Runs every kernel and its twin on equal arrays and compares every array of the call afterwards, to the last bit.

    New arrays hold a pattern, so that elements that only one of the two writes are found as well.

    Parameters
    ----------
    device : OpenCLBackend
    blocks : int
        Work-items of the serial passes (sort and tile lists).
    pattern : int
        The byte that new arrays are full of.
    """

    name = "kernel and twin"
    is_numpy = False
    startup_seconds = 0.0
    compile_seconds = 0.0
    most_pairs = 0

    def __init__(self, device: Backend, blocks: int, pattern: int = 0xAB) -> None:
        self.device, self.twin, self.pattern = device, TwinBackend(large_budget()), pattern
        self.sort_blocks = self.tile_blocks = blocks
        self.profile: defaultdict[str, float] | None = None
        self.launched: Counter[str] = Counter()

    def describe(self) -> dict[str, Any]:
        """As the device says."""
        return self.device.describe()

    def array(self, shape: tuple[int, ...], dtype: Any) -> _PairedArray:
        """An array on each side, full of the pattern."""
        array = _PairedArray(self.device.array(shape, dtype), self.twin.array(shape, dtype), shape, dtype)
        size = int(np.prod(shape)) * array.dtype.itemsize
        self.write(array, np.full(size, self.pattern, np.uint8).view(array.dtype))
        return array

    def write(self, array: _PairedArray, values: np.ndarray, offset: int = 0, stays: bool = False) -> None:
        """Write to both."""
        self.device.write(array.device, values, offset, stays)
        self.twin.write(array.host, values, offset)

    @contextmanager
    def mapped(self, array: _PairedArray) -> Iterator[np.ndarray]:
        """What is written goes to both."""
        with self.twin.mapped(array.host) as values:
            yield values
        with self.device.mapped(array.device) as ours:
            ours[...] = values

    def mark(self) -> Callable[[], None]:
        """The device's."""
        return self.device.mark()

    def read(
        self, array: _PairedArray, out: np.ndarray | None = None, offset: int = 0, waits: bool = True
    ) -> np.ndarray:
        """Read the device's."""
        return self.device.read(array.device, out, offset, waits)

    def fill(self, array: _PairedArray, value: int, count: int | None = None) -> None:
        """Fill both."""
        self.device.fill(array.device, value, count)
        self.twin.fill(array.host, value, count)

    def launch(self, name: str, size: tuple[int, ...], *args: Any) -> None:
        """Launch on both and compare."""
        self.launched[name] += 1
        self.device.launch(name, size, *(a.device if isinstance(a, _PairedArray) else a for a in args))
        self.twin.launch(name, size, *(a.host if isinstance(a, _PairedArray) else a for a in args))
        for place, arg in enumerate(args):
            if isinstance(arg, _PairedArray):
                ours, twins = self.device.read(arg.device), self.twin.read(arg.host)
                if not same_bits(ours, twins):
                    where = np.argwhere((ours != twins) & ~((ours != ours) & (twins != twins)))
                    at = tuple(where[0]) if len(where) else None
                    raise AssertionError(
                        f"{name} over {size}: argument {place} of shape {arg.shape}: {len(where)} elements differ, first {at}: "
                        f"kernel {ours[at] if at else ours!r}, twin {twins[at] if at else twins!r}"
                    )

    def close(self) -> None:
        """Close the device."""
        self.device.close()
