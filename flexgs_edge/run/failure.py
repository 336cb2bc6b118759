"""What is said of an error that ends a run, or one scene of several, and its exit code."""

from __future__ import annotations

import logging
from dataclasses import dataclass

from flexgs_edge.errors import BudgetError, FlexGSError, InputError
from flexgs_edge.files import DISK_FULL

INTERNAL = 1  # Exit code of a fault of ours
TRACEBACKS = logging.getLogger("flexgs_edge.tracebacks")
"""Where `--debug` shows the tracebacks of errors that end one scene of several."""


@dataclass(frozen=True)
class Failure:
    """An error in words."""

    words: str  # one line that starts in lower case
    exit_code: int  # `INTERNAL` for a fault of ours

    @property
    def line(self) -> str:
        """The line that the command prints."""
        return self.words if self.exit_code == INTERNAL else f"error: {self.words}"


def failure_of(error: BaseException) -> Failure:
    """Describe an error."""
    if isinstance(error, FlexGSError):  # before MemoryError, because a BudgetError is also one
        return Failure(str(error), error.exit_code)
    if isinstance(error, MemoryError):
        words = "out of memory: set --memory-limit to less than the machine has, so that work is cut into parts"
        return Failure(words, BudgetError.exit_code)
    if isinstance(error, OSError) and error.errno in DISK_FULL:
        return Failure(f"the disk is full ({error}); free some space or write elsewhere", BudgetError.exit_code)
    if isinstance(error, OSError) and error.filename is not None:
        return Failure(f"{error.filename}: {error.strerror}", InputError.exit_code)
    words = f"internal error: {type(error).__name__}: {error}"
    return Failure(f"{words}; this is a fault of flexgs-edge: please report it with the output of --debug", INTERNAL)
