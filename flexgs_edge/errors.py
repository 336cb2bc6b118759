"""The errors that a user can mend, and their exit codes.

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

from __future__ import annotations


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
