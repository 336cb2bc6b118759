"""Open the backend that a user names: an OpenCL device, or the NumPy twins."""

from __future__ import annotations

from flexgs_edge.kernels.backend import Backend, TwinBackend
from flexgs_edge.memory.budget import MemoryBudget


def open_backend(device: str | None, budget: MemoryBudget) -> Backend:
    """Open the backend that `device` names.

    `device`: `numpy` for the twins, else an OpenCL device as in `flexgs_edge.kernels.choose_device.choose_device`. We
    never fall back from one to the other silently. `budget`: counts every array of the backend. Raises `DeviceError` if
    the device does not exist, or failed its self-test.
    """
    if device == "numpy":
        return TwinBackend(budget)
    from flexgs_edge.kernels.opencl import OpenCLBackend
    from flexgs_edge.kernels.tested import choose_tested

    info, _ = choose_tested(device)
    return OpenCLBackend(info, budget)
