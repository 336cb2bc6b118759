"""One memory limit for the whole run, in bytes, and the planner that keeps it.

The limit counts what the process already holds (Python, libraries, the OpenCL compiler) and every array and device buffer that
a stage declares. A stage asks for `fixed` bytes plus `per_row` bytes. The planner answers with the rows that fit, or raises an
error that names a sufficient limit: the smallest one for this stage, or one for the whole run where it is foreseen.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

from flexgs_edge.errors import BudgetError
from flexgs_edge.memory.process import HeapWatch, available_memory, current_rss
from flexgs_edge.units import format_mib

LARGE = 2**20  # A stage that takes so many bytes or more has the heaps of this process checked
ROOM = 8 << 20
"""Spare bytes of a limit that an error names. Pages of libraries, heaps of threads and the compiler take some MiB more in one run
than in the next, mostly on a busy machine: docs/results/tuning.md#foresight"""


@dataclass
class MemoryBudget:
    """A memory limit, and the bytes that are taken from it."""

    limit: int  # bytes that the whole process may hold
    used: int = 0  # bytes already held; `from_limit` takes the resident memory of the process
    reclaimers: list[Callable[[int], None]] = field(default_factory=list)
    """Functions to call with the missing bytes before a stage is refused; each lets a cache free memory."""
    evictors: list[Callable[[], None]] = field(default_factory=list)
    """Functions that each free a whole scene on the device. The scene is loaded again when it is drawn next."""
    foreseen: Callable[[], int] | None = None
    """Reckons a limit that is expected to be enough for all stages. Only an error calls it, and names that limit."""
    runtime: int = 0
    """Bytes taken for a device's runtime. It stays loaded when the device is closed, and is counted once."""
    heap: HeapWatch | None = field(default_factory=HeapWatch)
    """Keeps freed memory from counting against the limit; None where pages of scratch files may lie above the limit."""

    @classmethod
    def from_limit(cls, limit: int | None) -> "MemoryBudget":
        """A budget of `limit` bytes; by default, the memory held now plus 3/4 of the memory that is available."""
        used = current_rss()
        return cls(limit if limit is not None else used + available_memory() * 3 // 4, used)

    @property
    def free(self) -> int:
        """Bytes not taken yet."""
        return self.limit - self.used

    def rows(self, stage: str, per_row: int, fixed: int = 0, minimum: int = 1, most: int = 1 << 20) -> int:
        """Rows of a chunk for `stage`: as many as fit, at most `most`.

        `stage`: name of the stage, for the error message. `per_row`, `fixed`: bytes that the stage needs: for each row,
        and in any case. `minimum`, `most`: least and most rows of a chunk. Raises `BudgetError` if not even `minimum`
        rows fit; the message names a sufficient limit.
        """
        rows = min(most, (self.free - fixed) // max(per_row, 1))
        if rows < minimum:
            self.require(stage, fixed + minimum * per_row)
            rows = minimum
        return rows

    def require(self, stage: str, size: int) -> None:
        """Raise `BudgetError` unless `size` more bytes fit; the message names a sufficient limit."""
        for reclaim in self.reclaimers:
            if size > self.free:
                reclaim(size - self.free)
        if size > self.free:
            enough = max(self.used + size, 0 if self.foreseen is None else self.foreseen()) + ROOM
            held = format_mib(self.used)
            found = f"needs {format_mib(size)} beside the {held} already held" if size else f"already holds {held}"
            counted = ", which counts later stages too" if enough > self.used + size + ROOM else ""
            raise BudgetError(
                f"{stage} {found}, but the memory limit is {format_mib(self.limit)}: "
                f"use --memory-limit {format_mib(enough)} or more{counted}"
            )

    def take(self, stage: str, size: int) -> None:
        """Take `size` bytes until `give` returns them; raises `BudgetError` if they do not fit."""
        self.require(stage, size)
        self.used += size
        if self.heap is not None and size >= LARGE and self.used > self.limit // 2:
            self.heap.check(self.limit)

    def hold(self, size: int) -> None:
        """Count `size` bytes that are held already. The next stage finds out whether the limit is enough."""
        self.used += size

    def give(self, size: int) -> None:
        """Return `size` bytes."""
        self.used -= size
