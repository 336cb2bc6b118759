"""`flexgs-edge devices`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from flexgs_edge.budget import format_mib
from flexgs_edge.cli import words
from flexgs_edge.errors import DeviceError

if TYPE_CHECKING:
    from flexgs_edge.device.select import DeviceInfo


@click.command(cls=words.SectionCommand)
@words.option(
    "Run", "--device", metavar="SPEC", help="Show which device this would choose: a number, part of a name, cpu or gpu."
)
@words.force_option
@words.json_option
@words.talk_options
def command(device: str | None, force: bool, json_path: str | None, quiet: bool) -> None:
    """List the OpenCL devices, their limits, whether they pass the self-test, and which one is used and why.

    The self-test builds and runs a small kernel and compares its result: a runtime that is installed need not work.

    \b
    Examples:
      flexgs-edge devices
      flexgs-edge devices --device gpu
      flexgs-edge devices --json - 2>/dev/null

    Exit code 4: no device works (or not the one asked for); the message says what to install.
    """
    words.start(quiet, json_path, force)
    from flexgs_edge.device.select import choose_device, list_devices

    devices = list_devices()
    failure: DeviceError | None = None
    try:
        chosen, reason = choose_device(device, devices)
        index: int | None = chosen.index
    except DeviceError as error:
        failure, reason, index = error, str(error), None
    lines = [line for info in devices for line in _device_lines(info)]
    if index is not None:
        lines.append(f"chosen: [{index}] ({reason})")
    record = {"devices": [info.to_json() for info in devices], "chosen": index, "reason": reason}
    words.emit("".join(line + "\n" for line in lines), record, json_path, force)
    if failure is not None:
        raise failure


def _device_lines(info: DeviceInfo) -> list[str]:
    return [
        f"[{info.index}] {info.name}",
        f"    {info.type}, {info.platform}, driver {info.driver}, {info.opencl_c}",
        f"    {info.compute_units} compute units, native float vectors of {info.native_width}, work-groups up to "
        f"{info.max_work_group}, local memory {info.local_bytes // 1024} KiB, global memory {format_mib(info.global_bytes)}, "
        f"buffers up to {format_mib(info.max_alloc_bytes)}",
        f"    self-test: {info.self_test}",
    ]
