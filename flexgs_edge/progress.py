"""What is said while work goes on: the log, and progress bars on stderr, of which quiet runs and pipes show none."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterable, Iterator
from typing import TypeVar

T = TypeVar("T")
LOG = logging.getLogger("flexgs_edge")


class Progress:
    """Shows progress bars on stderr, or none.

    `enabled`: show bars. By default, only if stderr is a terminal.
    """

    def __init__(self, enabled: bool | None = None) -> None:
        self.enabled = sys.stderr.isatty() if enabled is None else enabled

    def track(self, items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
        """Iterate over `items`, and show a bar with the name `label`."""
        if not self.enabled:
            yield from items
            return
        from tqdm import tqdm  # slow to import, and a quiet run does not need it

        yield from tqdm(items, desc=label, total=total, leave=False, file=sys.stderr)


SILENT = Progress(enabled=False)
