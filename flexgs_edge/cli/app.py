"""The command line: the group of subcommands, and `main`, which turns errors into messages and exit codes."""

import logging
import math
import os
import signal
import sys
import time
import traceback
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NoReturn

import click

from flexgs_edge._version import __version__
from flexgs_edge.cli.help_page import LazyGroup
from flexgs_edge.cli.talk import State, printable
from flexgs_edge.errors import InputError, failure_of

COMMANDS = {
    "compress": "Make a scene smaller: to a quality or to a size.",
    "decompress": "Decode a .fgs file to a .ply, or convert between formats.",
    "info": "Show what a scene file holds.",
    "trim": "Cut a layered .fgs file to a size, without the original.",
    "verify": "Check every byte of a .fgs file against its checksums.",
    "view": "Look at a scene in the browser.",
    "render": "Draw views of a scene as PNG files.",
    "views": "Draw all views of a scene on one sheet.",
    "evaluate": "Compare a scene with its original, view by view.",
    "study": "Run experiments on your own scenes: tables and charts.",
    "devices": "List the OpenCL devices, and say which one is used.",
}  # Subcommands and the first sentence of their help. They are repeated here so that `--help` imports no subcommand.
REPEAT_SECONDS = 1.0  # `timeout` sends its signal twice: to the program, and to its process group


@click.group(
    cls=LazyGroup,
    modules=("flexgs_edge.cli.commands", "flexgs_edge.cli.compress", "flexgs_edge.cli.study"),
    lines=COMMANDS,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(__version__, "-V", "--version", message="flexgs-edge %(version)s")
def command() -> None:
    """Make trained 3D Gaussian splatting scenes much smaller, without training.

    For a scene with cameras.json and images/ beside it:

    \b
      flexgs-edge compress scene/point_cloud.ply -o scene.fgs
      flexgs-edge info scene.fgs
      flexgs-edge decompress scene.fgs -o decoded.ply

    A scene (INPUT) is a .ply in INRIA's layout, a .fgs, .spz, .sog or .compressed.ply file, or the folder that 3DGS training
    writes. The summary goes to stdout, logs and errors to stderr. --json FILE writes the same record for programs; with
    --json - it goes to stdout, and the summary to stderr. Files that exist are overwritten only with -f.

    \b
    Exit codes:
      0    done
      1    a fault of this program
      2    misuse, bad input or a damaged file
      3    target not reachable
      4    no usable device
      5    memory limit or disk too small
      130  interrupted

    COMMAND --help explains a command, with examples.
    """


def main(argv: Sequence[str] | None = None) -> NoReturn:
    """Run the command line and exit with its code. Only this function turns errors into messages."""
    _open_streams()
    state = State()
    with suppress(ValueError):  # raised outside the main thread, whose owner handles signals
        for number in (signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) != signal.SIG_IGN:  # as under `nohup`
                _exit_on(number)
    try:
        code = command.main(
            args=None if argv is None else list(argv), prog_name="flexgs-edge", standalone_mode=False, obj=state
        )
    except BaseException as error:
        if state.debug and not isinstance(error, SystemExit):
            traceback.print_exc()
        code = _exit_code(error)
    sys.exit(code if isinstance(code, int) else 0)


def _open_streams() -> None:
    """Read nothing from, and write nowhere to, standard streams that are closed. Files that we open would take their numbers."""
    for number, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        try:
            os.fstat(number)
        except OSError:
            found = os.open(os.devnull, os.O_RDWR)
            if found != number:
                os.dup2(found, number)
                os.close(found)
            setattr(sys, name, os.fdopen(number, mode, encoding="utf-8", closefd=False))


def _exit_on(number: int) -> None:
    """End at this signal as at Ctrl-C, so that no partly written file is left behind.

    The same signal again, within `REPEAT_SECONDS`, would break the cleaning up.
    """
    heard = -math.inf

    def end(number: int, frame: object) -> None:
        nonlocal heard
        if time.monotonic() - heard >= REPEAT_SECONDS:
            heard = time.monotonic()
            raise SystemExit(128 + number)

    signal.signal(number, end)


def _exit_code(error: BaseException) -> int:
    """Print the error on stderr, and return its exit code."""
    if isinstance(error, SystemExit):
        return error.code if isinstance(error.code, int) else 0
    if isinstance(error, (KeyboardInterrupt, click.Abort)):
        return _say("interrupted; nothing half-written was left behind", 130)
    if isinstance(error, click.ClickException):
        error.show()
        return InputError.exit_code
    found = failure_of(error)
    return _say(found.line, found.exit_code)


def _say(text: Any, code: int) -> int:
    logging.shutdown()
    click.echo(printable(f"flexgs-edge: {text}"), err=True)
    return code
