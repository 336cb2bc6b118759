"""`devices`: the OpenCL devices, whether they work, and which one is used."""

from __future__ import annotations

from flexgs_edge.errors import DeviceError
from flexgs_edge.kernels import choose_device as kernels
from flexgs_edge.report.file_results import DevicesResult


def devices(device: str | None = None) -> DevicesResult:
    """List the OpenCL devices, test each, and say which one is used.

    Parameters
    ----------
    device : str, optional
        Which one would be chosen: a number, part of a name, `cpu` or `gpu`.

    Returns
    -------
    DevicesResult
        `chosen` is `None` where none works; nothing is raised for that.
    """
    found = tuple(kernels.list_devices())
    try:
        chosen, reason = kernels.choose_device(device, list(found))
    except DeviceError as error:
        return DevicesResult(found, None, str(error))
    return DevicesResult(found, chosen.index, reason)
