"""Commands that Ctrl-C reaches whatever started the suite, and that end with their test."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

GRACE = 15
"""Seconds that a command has to clean up after a test that failed."""

# Suites started in the background often ignore SIGINT. Children inherit that, and a shell cannot undo it.
_LAUNCHER = """
import fcntl, os, signal, sys, termios
signal.signal(signal.SIGINT, signal.SIG_DFL)
if os.isatty(0):
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)
os.execvp(sys.argv[1], sys.argv[1:])
"""


@contextmanager
def running(*command: str, **words: Any) -> Iterator[subprocess.Popen[str]]:
    """The command in a session of its own, with the default answer to SIGINT; a terminal as its stdin controls the session.

    Whatever the test makes of it, nothing of the command runs or is open afterwards.
    """
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **words}
    with subprocess.Popen(
        [sys.executable, "-c", _LAUNCHER, *command], text=True, start_new_session=True, **streams
    ) as process:
        try:
            yield process
        finally:
            if process.poll() is None:
                _end(process)


def _end(process: subprocess.Popen[str]) -> None:
    process.terminate()
    try:
        process.wait(GRACE)
    except subprocess.TimeoutExpired:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
