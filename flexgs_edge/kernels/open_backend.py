"""The choice between OpenCL kernels and their NumPy twins."""

from __future__ import annotations

from flexgs_edge.kernels.backend import Backend, TwinBackend
from flexgs_edge.memory.budget import MemoryBudget


def open_backend(device: str | None, budget: MemoryBudget) -> Backend:
    """The backend that `device` names.

    Parameters
    ----------
    device : str or None
        `numpy` for the twins; otherwise an OpenCL device as in `flexgs_edge.kernels.choose_device.choose_device`. There is no
        silent fallback from one to the other.
    budget : MemoryBudget
        Every array of the backend is taken from it.

    Raises
    ------
    DeviceError
        When the device does not exist or failed its self-test.
    """
    if device == "numpy":
        return TwinBackend(budget)
    from flexgs_edge.kernels.choose_device import choose_device, list_devices
    from flexgs_edge.kernels.opencl import OpenCLBackend

    info, _ = choose_device(device, list_devices())
    return OpenCLBackend(info, budget)
