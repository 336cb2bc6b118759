"""`devices`: the OpenCL devices, whether they work, and which one is used."""

from __future__ import annotations

from typing import TYPE_CHECKING

from flexgs_edge.units import format_mib

if TYPE_CHECKING:
    from flexgs_edge.kernels.choose_device import DeviceInfo


def device_lines(info: DeviceInfo) -> list[str]:
    """A device in a few lines."""
    return [
        f"[{info.index}] {info.name}",
        f"    {info.type}, {info.platform}, driver {info.driver}, {info.opencl_c}",
        f"    {info.compute_units} compute units, native float vectors of {info.native_width}, work-groups up to "
        f"{info.max_work_group}, local memory {info.local_bytes // 1024} KiB, global memory {format_mib(info.global_bytes)}, "
        f"buffers up to {format_mib(info.max_alloc_bytes)}",
        f"    self-test: {info.self_test}",
    ]
