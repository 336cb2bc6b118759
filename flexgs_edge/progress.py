"""Progress bars for long work: one door, so that quiet runs and pipes stay clean."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from typing import TypeVar

T = TypeVar("T")


class Progress:
    """Hands out progress bars on stderr, or none.

    Parameters
    ----------
    enabled : bool, optional
        Show bars. Default: only when stderr is a terminal.
    """

    def __init__(self, enabled: bool | None = None) -> None:
        self.enabled = sys.stderr.isatty() if enabled is None else enabled

    def track(self, items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
        """Iterate over `items` with a bar named `label`."""
        if not self.enabled:
            yield from items
            return
        from tqdm import tqdm  # slow to import; a quiet run need not pay for it

        yield from tqdm(items, desc=label, total=total, leave=False, file=sys.stderr)


SILENT = Progress(enabled=False)
