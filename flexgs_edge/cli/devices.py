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
@help_page.option(
    help_page.DEVICE,
    "--self-test",
    "self_test",
    is_flag=True,
    help="Test every device anew, also those with a verdict.",
)
@shared_options.write_options
def command(device: str | None, self_test: bool, force: bool, json_path: str | None, quiet: bool) -> None:
    """List the OpenCL devices, and say which one is used.

    Shows the limits of every device, and whether it passes the self-test: it runs all kernels on small scenes, and every
    result must have the right bits. The verdict is kept until the driver or the kernels change.

    \b
    Examples:
      flexgs-edge devices
      flexgs-edge devices --device gpu
      flexgs-edge devices --json - 2>/dev/null

    Exit code 4: no device works, or not the one asked for. The message says what to install.
    """
    talk.start(quiet, json_path, force)
    from flexgs_edge.commands.devices import devices

    result = devices(device, self_test)
    talk.emit(result.summary(), result.to_json(), json_path, force)
    if result.chosen is None:
        raise DeviceError(result.reason)
