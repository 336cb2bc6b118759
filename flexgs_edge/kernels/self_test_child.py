"""Test one device in a process of its own: `python -m flexgs_edge.kernels.self_test_child INDEX NAME`.

Prints the name of each kernel before it is built, and the verdict as JSON at the end.
"""

from __future__ import annotations

import contextlib
import json
import resource
import sys
from dataclasses import asdict

from flexgs_edge.errors import DeviceError
from flexgs_edge.kernels.choose_device import list_devices, probed
from flexgs_edge.kernels.launch_record import load_record
from flexgs_edge.kernels.opencl import OpenCLBackend
from flexgs_edge.kernels.self_test import verdict
from flexgs_edge.kernels.tested import MARK
from flexgs_edge.kernels.verdict import Verdict
from flexgs_edge.memory.budget import MemoryBudget


def test(index: int, name: str) -> Verdict:
    """Test the device with this index; another name means that devices came or went."""
    devices = list_devices(self_test=False)
    if index >= len(devices) or devices[index].name != name:
        return Verdict(f"the device is gone: [{index}] is no longer {name}")
    info = probed(devices[index])
    if not info.usable:
        return Verdict(info.self_test)
    try:
        backend = OpenCLBackend(info, MemoryBudget(1 << 40))
    except DeviceError as error:
        return Verdict(str(error))
    return Verdict(verdict(load_record(), backend, _say), info.loop_steps)


def _say(text: str) -> None:
    print(f"{MARK}{text}", flush=True)


if __name__ == "__main__":
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _say(json.dumps(asdict(test(int(sys.argv[1]), sys.argv[2]))))
