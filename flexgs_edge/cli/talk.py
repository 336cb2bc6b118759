"""Output of a command: the summary to stdout, everything else to stderr."""

import logging
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from inspect import signature
from pathlib import Path
from typing import Any

import click

from flexgs_edge.errors import InputError
from flexgs_edge.progress import Progress
from flexgs_edge.report.run_info import Result

CONTROLS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
"""Characters that move the cursor, set colours or titles, or turn the direction of text: a file's strings may hold them."""


def printable(text: str) -> str:
    r"""The text with control characters but tabs and ends of lines as escapes.

    >>> printable("a\x1b]0;title\x07b")
    'a\\x1b]0;title\\x07b'
    """
    return CONTROLS.sub(lambda found: found.group().encode("unicode_escape").decode(), text)


class PrintableFormatter(logging.Formatter):
    """Lines of a log without control characters."""

    def format(self, record: logging.LogRecord) -> str:
        """The line of a record."""
        return printable(super().format(record))


def told(command: Callable[..., Result]) -> Callable[..., None]:
    """Open the log before a command, and print its result and write its JSON after it.

    The command gets the progress bars, and of the options of every command, those that it names.
    """

    @wraps(command)
    def run(json_path: str | None, quiet: bool, force: bool, **words: Any) -> None:
        progress = start(quiet, json_path, force, words.get("report"))
        offered = {"progress": progress, "quiet": quiet, "force": force}
        taken = {name: value for name, value in offered.items() if name in signature(command).parameters}
        result = command(**words, **taken)
        emit(result.summary(), result.to_json(), json_path, force)

    return run


@dataclass
class State:
    """Settings that `main` needs after a command has failed."""

    debug: bool = False


def set_debug(ctx: click.Context, param: click.Parameter, value: bool) -> None:
    """Remember `--debug`, so that `main` prints the traceback of an error."""
    if value and isinstance(ctx.obj, State):
        ctx.obj.debug = True


def start(quiet: bool, json_path: str | None = None, force: bool = False, report: str | None = None) -> Progress:
    """Set up the log on stderr, check before any work that the JSON file can be written, and return the progress bars."""
    log = logging.getLogger("flexgs_edge")
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(PrintableFormatter("flexgs-edge: %(message)s"))
    log.handlers = [handler]
    log.setLevel(logging.WARNING if quiet else logging.INFO)
    log.propagate = False
    context = click.get_current_context(silent=True)
    state = None if context is None else context.find_object(State)
    logging.getLogger(f"{log.name}.tracebacks").setLevel(logging.DEBUG if state and state.debug else logging.WARNING)
    if json_path not in (None, "-"):
        from flexgs_edge.files import check_writable

        if report is not None and Path(str(json_path)).resolve() == (Path(report) / "result.json").resolve():
            raise InputError(f"--json {json_path}: --report {report} writes this file already; leave --json out")
        check_writable(str(json_path), force)
    return Progress(enabled=False if quiet else None)


def emit(text: str, record: dict[str, Any] | list[Any], json_path: str | None, force: bool = False) -> None:
    """Print the summary to stdout, and write the JSON. With `--json -` the JSON goes to stdout and the summary to stderr."""
    click.echo(printable(text), nl=False, err=json_path == "-")
    if json_path is None:
        return
    from flexgs_edge.report.as_json import json_text

    words = json_text(record)
    if json_path == "-":
        click.echo(words, nl=False)
        return
    from flexgs_edge.files import atomic_write

    with atomic_write(json_path, force) as file:
        file.write(words.encode())
