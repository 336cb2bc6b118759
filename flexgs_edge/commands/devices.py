"""`devices`: list the OpenCL devices, test them, and choose one."""

from __future__ import annotations

from flexgs_edge.errors import DeviceError
from flexgs_edge.kernels import choose_device as kernels
from flexgs_edge.report.file_results import DevicesResult


def devices(device: str | None = None) -> DevicesResult:
    """List the OpenCL devices, test each, and choose the one that other commands would use.

    Parameters
    ----------
    device : str, optional
        Device to choose: a number, part of a name, `cpu` or `gpu`. Default: the first GPU that works, else
        a processor.

    Returns
    -------
    DevicesResult
        `chosen` is `None` if no device works; this raises no error.
    """
    found = tuple(kernels.list_devices())
    try:
        chosen, reason = kernels.choose_device(device, list(found))
    except DeviceError as error:
        return DevicesResult(found, None, str(error))
    return DevicesResult(found, chosen.index, reason)
