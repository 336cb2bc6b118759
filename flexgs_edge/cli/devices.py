"""`flexgs-edge devices`."""

from __future__ import annotations

import click

from flexgs_edge.cli import help_page, shared_options, talk
from flexgs_edge.errors import DeviceError


@click.command(cls=help_page.SectionCommand)
@help_page.option(
    help_page.DEVICE,
    "--device",
    metavar="SPEC",
    help="Say which device this would choose: a number, part of a name, cpu or gpu.",
)
@shared_options.write_options
def command(device: str | None, force: bool, json_path: str | None, quiet: bool) -> None:
    """List the OpenCL devices, and say which one is used.

    Shows the limits of every device, and whether it passes a self-test. The self-test runs a small kernel and compares the
    result, because an installed device may still fail.

    \b
    Examples:
      flexgs-edge devices
      flexgs-edge devices --device gpu
      flexgs-edge devices --json - 2>/dev/null

    Exit code 4: no device works, or not the one asked for. The message says what to install.
    """
    talk.start(quiet, json_path, force)
    from flexgs_edge.commands.devices import devices

    result = devices(device)
    talk.emit(result.summary(), result.to_json(), json_path, force)
    if result.chosen is None:
        raise DeviceError(result.reason)
