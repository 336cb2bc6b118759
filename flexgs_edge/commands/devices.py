"""`devices`: list the OpenCL devices, test them, and choose one."""

from flexgs_edge.errors import DeviceError
from flexgs_edge.kernels.choose_device import choose_device
from flexgs_edge.kernels.tested import list_with_verdicts
from flexgs_edge.report.file_results import DevicesResult


def devices(device: str | None = None, self_test: bool = False) -> DevicesResult:
    """List the OpenCL devices, test those that have no verdict yet, and choose the one that other commands would use.

    `device`: device to choose: a number, part of a name, `cpu` or `gpu`. Default: the first GPU that works, else a
    processor. `self_test`: test every device anew. Default: verdicts of earlier tests hold, until kernels or drivers
    change. Returns `chosen` is `None` if no device works; this raises no error.
    """
    found = tuple(list_with_verdicts(self_test))
    try:
        chosen, reason = choose_device(device, list(found))
    except DeviceError as error:
        return DevicesResult(found, None, str(error))
    return DevicesResult(found, chosen.index, reason)
