"""The choice that a search of `paper` makes: how much to prune, in thousandths."""

from __future__ import annotations

from dataclasses import dataclass

from flexgs_edge.errors import InputError


@dataclass(frozen=True, order=True)
class Choice:
    """How much to prune, in thousandths of the N rows."""

    prune: int  # share of the rows that is removed (the paper's p)
    sh: int  # share of the rows that loses its SH above degree 0 (the paper's s)

    def __post_init__(self) -> None:
        if self.prune < 0 or self.sh < 0 or self.prune + self.sh > 1000:
            raise InputError(
                f"prune rate {self.prune / 1000} and SH rate {self.sh / 1000}: "
                "expected rates from 0 to 1 that add up to at most 1"
            )

    @classmethod
    def from_rates(cls, prune: float, sh: float) -> Choice:
        """A choice from shares between 0 and 1, rounded to thousandths.

        >>> Choice.from_rates(0.4, 0.3)
        Choice(prune=400, sh=300)
        """
        if not (0 <= prune <= 1 and 0 <= sh <= 1):
            raise InputError(
                f"prune rate {prune} and SH rate {sh}: expected rates from 0 to 1 that add up to at most 1"
            )
        return cls(round(prune * 1000), round(sh * 1000))

    def pruned(self, count: int) -> int:
        """Number of rows removed from a scene of `count` rows."""
        return count * self.prune // 1000

    def boundary(self, count: int) -> int:
        """Rank below which a row has lost its SH, or is removed."""
        return count * (self.prune + self.sh) // 1000
