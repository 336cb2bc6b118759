"""The errors that a user can mend, their exit codes, and what is said of an error that ends a run.

    FlexGSError
    |-- InputError    bad scene, cameras, photos or arguments        exit code 2  also a ValueError
    |   `-- FormatError   a file that breaks its own format          exit code 2
    |-- TargetError   the asked quality or size cannot be reached    exit code 3  also a ValueError
    |-- DeviceError   no usable OpenCL device, a failed build        exit code 4  also a RuntimeError
    `-- BudgetError   the memory limit or the disk is too small      exit code 5  also a MemoryError

Any other error is a bug of ours (exit code 1).
The second base is for callers who know only Python's errors. Trap: `except ValueError` catches an `InputError` that was raised
inside its `try`.
A message says where (file, field, row or byte), what was expected, what was found, and what to do.
"""

import errno
import logging
from dataclasses import dataclass

DISK_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
INTERNAL = 1  # Exit code of a fault of ours
TRACEBACKS = logging.getLogger("flexgs_edge.tracebacks")
"""Where `--debug` shows the tracebacks of errors that end one scene of several."""


def brief(value: object, most: int = 80) -> str:
    """The beginning of a value, for messages.

    It stands numbers with more digits than Python writes, and lists nested deeper than Python can follow.

    >>> brief([1, 2]), brief("a" * 9, 8)
    ('[1, 2]', "'aaaa...")
    """
    try:
        text = repr(value)
    except ValueError:
        return "an integer of very many digits"
    except RecursionError:
        return "lists in lists of very many levels"
    return text if len(text) <= most else text[: most - 3] + "..."


class FlexGSError(Exception):
    """Base of all errors that a user can mend."""

    exit_code = 1


class InputError(FlexGSError, ValueError):
    """A scene, camera file, photo or argument that cannot be used as it is."""

    exit_code = 2


class FormatError(InputError):
    """A file that breaks the rules of its own format (truncated, corrupt, unknown version)."""


class TargetError(FlexGSError, ValueError):
    """A target of quality or size that the method cannot reach; the message names the closest point."""

    exit_code = 3


class DeviceError(FlexGSError, RuntimeError):
    """No usable OpenCL device, an unknown device name, or a kernel that does not build."""

    exit_code = 4


class BudgetError(FlexGSError, MemoryError):
    """The memory limit or the disk is too small; the message names a limit that is expected to be enough."""

    exit_code = 5


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
