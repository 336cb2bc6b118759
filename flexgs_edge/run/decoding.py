"""Decide how to decode a file: on which device, how many chunks ahead, to memory or to scratch files."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from weakref import WeakKeyDictionary

from flexgs_edge.codec.v2.device.encode_kernels import device_bytes
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.codec.v2.header import CHUNK_ROWS
from flexgs_edge.errors import BudgetError
from flexgs_edge.kernels.backend import Backend
from flexgs_edge.kernels.choose_device import DeviceInfo
from flexgs_edge.kernels.tested import BUILD_BYTES, RUNTIME_BYTES, counted_backend, processors_with_verdicts
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.memory.process import trim_heap
from flexgs_edge.memory.storage import IN_MEMORY
from flexgs_edge.progress import Stopwatch
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource, SceneSource, read_all

DEVICE_ROWS = 40_000
"""A device codes scenes with at least this many Gaussians. Below, starting the kernels takes longer than they save:
docs/results/tuning.md#device_rows"""


def decoder(
    device: str | None,
    source: SceneSource,  # The scene to decode. Devices decode container version 2 only.
    budget: MemoryBudget,  # pays for the OpenCL runtime
    clock: Stopwatch,  # times the stage `device`
    least: int = DEVICE_ROWS,  # without a named device, smaller scenes are decoded by NumPy
    devices: Callable[[], list[DeviceInfo]] = processors_with_verdicts,  # lists the devices of this machine
) -> Backend | None:
    """Open the OpenCL device that decodes a scene.

    Only processors decode. One work-item decodes a whole chunk, and a single work-item of a GPU is too slow for that.
    NumPy gives the same results.

    `device`: as the user named it. Default: a processor, if one has a working driver, the scene has at least `least`
    Gaussians, and its runtime fits into memory. Returns `None`: NumPy decodes. Raises `DeviceError` if the named device
    does not exist or failed its self-test.
    """
    if device == "numpy" or not isinstance(source, GridSource):
        return None
    if device is None:
        if source.count < least:
            return None
        if budget.free < RUNTIME_BYTES + BUILD_BYTES + source.device_bytes(1):
            return None
        if not any(found.type == "cpu" and found.usable for found in devices()):
            return None
        device = "cpu"
    backend = counted_backend(device, budget, clock)
    return backend if backend.threads else None


def decode_bytes(source: SceneSource, backend: Backend | None) -> int:
    """Bytes that decoding takes at least, one chunk at a time; 0 where nothing is to be decoded."""
    if not isinstance(source, GridSource):
        return 0
    return source.table_bytes + source.chunk_bytes if backend is None else source.device_bytes(1)


@contextmanager
def ahead(source: SceneSource, budget: MemoryBudget, backend: Backend | None = None) -> Iterator[None]:
    """Decode the next chunks while the caller uses one, as far as memory allows."""
    if not isinstance(source, GridSource):
        yield
        return
    most = 0 if backend is None else min(backend.threads, source.threads)
    at_once = max((n for n in range(1, most + 1) if source.device_bytes(n) <= budget.free), default=0)
    if backend is not None and at_once:
        with source.on_device(backend, at_once), source.whole_in_order(at_once):
            yield
        return
    threads = source.threads
    while threads > 1 and budget.free < source.table_bytes + (threads + 1) * source.chunk_bytes:
        threads -= 1
    with source.whole_in_order(threads):
        yield


def decoded_once(source: SceneSource, budget: MemoryBudget, spare: int, backend: Backend | None) -> SceneSource:
    """Decode a file's scene to memory, so that it can be read several times, if it fits there beside `spare` bytes."""
    size = source.count * sum(4 * source.width(name) for name in FIELD)
    if not isinstance(source, GridSource) or budget.free < size + decode_bytes(source, backend) + spare:
        return source
    budget.take("the decoded scene", size)
    with ahead(source, budget, backend):
        planes = read_all(source, IN_MEMORY)
    return MemorySource(planes, source.sh_degree, source.origin, source.name, source.sh_count)


def read_often(source: SceneSource, budget: MemoryBudget, spare: int, backend: Backend) -> SceneSource:
    """Prepare a scene for being read several times while other work takes `spare` bytes.

    A file that is not decoded to memory is decoded at each reading, by NumPy. What that takes is taken from the budget.
    """
    if not isinstance(source, GridSource):
        return source
    once = decoded_once(source, budget, spare, coding_device(backend, budget, source.count, source.sh_degree))
    if once is source:
        budget.take("decoding the file", decode_bytes(source, None))
    return once


def decoded(source: SceneSource, renderer: Renderer) -> SceneSource:
    """Prepare a file's scene for drawing several views.

    A renderer with scratch files reads a scene again for each view, so the file is decoded once, to scratch files. The view
    buffers are freed first to make room for the decoder. A renderer without scratch files reads the source once, and gets it
    unchanged.
    """
    storage, budget = renderer.storage, renderer.budget
    if not storage.spills:
        return source
    renderer.release()
    trim_heap()
    if isinstance(source, GridSource):
        # Pages of libraries, which the budget counts and a limit on anonymous memory does not, leave room for `table_bytes`.
        budget.require("decoding the file", source.chunk_bytes)
    with ahead(source, budget):
        planes = read_all(source, storage)
    trim_heap()
    return MemorySource(planes, source.sh_degree, source.origin, source.name)


def coding_device(
    backend: Backend | None,
    budget: MemoryBudget,
    count: int,
    sh_degree: int,
    devices: Callable[[], list[DeviceInfo]] = processors_with_verdicts,
) -> Backend | None:
    """Return what should entropy-code this scene beside `backend`; `None`: NumPy codes it, to the same bytes.

    That is `backend` itself if it is a processor, else a processor with a working driver, if there is one. The scene must be
    large enough to gain from it, and the free memory enough for its buffers.
    """
    if backend is None or backend.is_numpy or count < DEVICE_ROWS:
        return None
    coder = backend if backend.threads else _processor_beside(backend, budget, devices)
    return coder if coder is not None and coder.threads * device_bytes(CHUNK_ROWS, sh_degree) <= budget.free else None


_beside: WeakKeyDictionary[Backend, Backend | None] = WeakKeyDictionary()
"""The processors that code for devices which cannot. They are opened once."""


def _processor_beside(
    backend: Backend, budget: MemoryBudget, devices: Callable[[], list[DeviceInfo]]
) -> Backend | None:
    """The processor that codes for a device such as a GPU."""
    if backend not in _beside:
        opened = None
        if any(found.type == "cpu" and found.usable and not found.loop_steps for found in devices()):
            with suppress(BudgetError):  # without room for its runtime, NumPy codes
                opened = counted_backend("cpu", budget, Stopwatch())
        _beside[backend] = opened if opened is not None and opened.threads else None
    return _beside[backend]
