"""One memory limit for the whole run, in bytes, and the planner that keeps it.

The limit counts everything: what the process holds when planning starts (Python, libraries, the OpenCL compiler)
plus every array and device buffer that a stage declares. A stage says what it needs as `fixed` bytes plus `per_row`
bytes; the planner answers with the rows that fit, or raises with the smallest limit that would do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from flexgs_edge.errors import BudgetError
from flexgs_edge.memory.process import available_memory, current_rss
from flexgs_edge.units import format_mib


@dataclass
class MemoryBudget:
    """A limit in bytes and what is taken from it.

    Parameters
    ----------
    limit : int
        Bytes that the whole process may hold.
    used : int
        Bytes held when planning starts, by default what the process holds now.
    """

    limit: int
    used: int = 0
    reclaimers: list[Callable[[int], None]] = field(default_factory=list)
    """Called with the bytes that are short before a stage is refused: caches give back what they can spare."""

    @classmethod
    def from_limit(cls, limit: int | None) -> MemoryBudget:
        """A budget of `limit` bytes, or of 3/4 of the memory that is free now."""
        used = current_rss()
        return cls(limit if limit is not None else used + available_memory() * 3 // 4, used)

    @property
    def free(self) -> int:
        """Bytes not yet taken."""
        return self.limit - self.used

    def rows(self, stage: str, per_row: int, fixed: int = 0, minimum: int = 1, most: int = 1 << 20) -> int:
        """Rows of a chunk for `stage`: as many as fit, at most `most`.

        Raises
        ------
        BudgetError
            When not even `minimum` rows fit; the message names the smallest limit that would do.
        """
        rows = min(most, (self.free - fixed) // max(per_row, 1))
        if rows < minimum:
            self.require(stage, fixed + minimum * per_row)
            rows = minimum
        return rows

    def require(self, stage: str, size: int) -> None:
        """Check that `size` more bytes fit (raises `BudgetError` naming the smallest limit that would)."""
        for reclaim in self.reclaimers:
            if size > self.free:
                reclaim(size - self.free)
        if size > self.free:
            raise BudgetError(
                f"{stage} needs {format_mib(size)} beside the {format_mib(self.used)} already held, "
                f"but the memory limit is {format_mib(self.limit)}: use --memory-limit {format_mib(self.used + size)} or more"
            )

    def take(self, stage: str, size: int) -> None:
        """Take `size` bytes for as long as the stage lasts (give them back with `give`)."""
        self.require(stage, size)
        self.used += size

    def give(self, size: int) -> None:
        """Return `size` bytes."""
        self.used -= size
