"""How a file is decoded: on which device, how many chunks ahead, to memory or to scratch files."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from flexgs_edge.codec.v2.chunk_plan import CHUNK_ROWS
from flexgs_edge.codec.v2.device.encode_kernels import device_bytes
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.kernels.backend import Backend
from flexgs_edge.kernels.choose_device import DeviceInfo, list_devices
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.run.clock import Stopwatch
from flexgs_edge.run.open_bench import counted_backend
from flexgs_edge.scene.source import MemorySource, SceneSource, read_all

DECODE_BYTES = 800
"""Bytes a row that decoding a chunk holds: codes, features, neighbours' weights, sums."""
DEVICE_ROWS = 40_000
"""Gaussians from which a device codes. Below, the kernels take longer to start than they save:
docs/results/tuning.md#device_rows"""


def decoder(
    device: str | None,
    source: SceneSource,
    budget: MemoryBudget,
    clock: Stopwatch,
    least: int = DEVICE_ROWS,
    devices: Callable[[], list[DeviceInfo]] = list_devices,
) -> Backend | None:
    """The device that decodes a scene; None: NumPy does, with the same results.

    That is so for files that are not of container version 2, with `device` "numpy", on GPUs (a work-item decodes a chunk: theirs
    would crawl), and, unless a device is named, for scenes too small to make up for opening one, and where no processor has a
    driver that works.

    Parameters
    ----------
    device : str or None
        As the user names it.
    source : SceneSource
        What is decoded.
    budget, clock
        Of the run.
    least : int, optional
        Gaussians from which a device decodes that nobody named.
    devices : callable, optional
        Lists those that there are.

    Raises
    ------
    DeviceError
        When the device that is named does not exist or failed its self-test.
    """
    if device == "numpy" or not isinstance(source, GridSource):
        return None
    if device is None:
        if source.count < least:
            return None
        if not any(found.type == "cpu" and found.usable for found in devices()):
            return None
        device = "cpu"
    backend = counted_backend(device, budget, clock)
    return backend if backend.threads else None


@contextmanager
def ahead(source: SceneSource, budget: MemoryBudget, backend: Backend | None = None) -> Iterator[None]:
    """Decoding of the next chunks while one is written, where memory allows."""
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
    chunk = min(source.count, CHUNK_ROWS) * DECODE_BYTES
    while threads > 1 and budget.free < (threads + 1) * chunk:
        threads -= 1
    with source.whole_in_order(threads):
        yield


def decoded(source: SceneSource, renderer: Renderer) -> SceneSource:
    """A file's scene for a renderer that draws several views of it: decoded once, to scratch files, where scenes lie there.

    Otherwise it is the source as it is, which views in memory read once. Views give their memory to the decoder.
    """
    storage, budget = renderer.storage, renderer.budget
    if not storage.spills:
        return source
    renderer.release()
    budget.require("decoding the file", min(source.count, CHUNK_ROWS) * DECODE_BYTES)
    with ahead(source, budget):
        planes = read_all(source, storage)
    return MemorySource(planes, source.sh_degree, source.origin, source.name)


def coding_device(backend: Backend | None, budget: MemoryBudget, count: int, sh_degree: int) -> Backend | None:
    """The backend, where it codes large scenes well and memory has room for its work; None: NumPy does, with the same bytes."""
    if backend is None or not backend.threads or count < DEVICE_ROWS:
        return None
    return backend if backend.threads * device_bytes(CHUNK_ROWS, sh_degree) <= budget.free else None
