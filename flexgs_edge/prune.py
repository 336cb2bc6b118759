"""ADP, attribute-discriminative pruning: which rows go, and which rows keep everything but their SH.

Source: FlexGaussian (ACM MM 2025), section on ADP. Rates are integers in thousandths of N, so that the same choice
means the same rows everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from flexgs_edge.errors import InputError

if TYPE_CHECKING:
    from flexgs_edge.scene.source import SceneSource


@dataclass(frozen=True, order=True)
class Choice:
    """How much to prune, in thousandths of N.

    Parameters
    ----------
    prune : int
        Share of the rows that is removed (the paper's p).
    sh : int
        Share of the rows that loses SH above degree 0 (the paper's s).
    """

    prune: int
    sh: int

    def __post_init__(self) -> None:
        if self.prune < 0 or self.sh < 0 or self.prune + self.sh > 1000:
            raise InputError(
                f"prune rate {self.prune / 1000} and SH rate {self.sh / 1000}: "
                "expected rates from 0 to 1 that add up to at most 1"
            )

    @classmethod
    def from_rates(cls, prune: float, sh: float) -> Choice:
        """A choice from shares of one, rounded to thousandths.

        >>> Choice.from_rates(0.4, 0.3)
        Choice(prune=400, sh=300)
        """
        if not (0 <= prune <= 1 and 0 <= sh <= 1):
            raise InputError(
                f"prune rate {prune} and SH rate {sh}: expected rates from 0 to 1 that add up to at most 1"
            )
        return cls(round(prune * 1000), round(sh * 1000))

    def pruned(self, count: int) -> int:
        """Rows removed from a scene of `count` rows."""
        return count * self.prune // 1000

    def boundary(self, count: int) -> int:
        """Rank below which a row has no SH any more (or is gone)."""
        return count * (self.prune + self.sh) // 1000


def order_from_scores(scores: np.ndarray) -> np.ndarray:
    """Rows from the least to the most important; ties by index.

    Parameters
    ----------
    scores : np.ndarray
        [N] f64; infinities are allowed.

    Returns
    -------
    np.ndarray
        [N] i64.

    Raises
    ------
    InputError
        When a score is NaN: its place would depend on the sort.
    """
    scores = np.asarray(scores, np.float64)
    if scores.ndim != 1:
        raise InputError(f"scores: expected one number a row, got an array of shape {scores.shape}")
    bad = np.flatnonzero(np.isnan(scores))
    if len(bad):
        raise InputError(f"scores: {len(bad)} of {len(scores)} are NaN, the first at row {bad[0]}: expected numbers")
    return np.argsort(scores, kind="stable").astype(np.int64, copy=False)


def ranks_from_order(order: np.ndarray) -> np.ndarray:
    """[N] i64 rank of every row (0 is the least important): the inverse of `order_from_scores`' permutation."""
    ranks = np.empty(len(order), np.int64)
    ranks[order] = np.arange(len(order), dtype=np.int64)
    return ranks


def select_rows(ranks: np.ndarray, choice: Choice, has_sh: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Rows that stay, in two blocks, each in input order.

    The rates count over all N rows, as in the paper: the `choice.pruned(N)` lowest ranks go, ranks up to
    `choice.boundary(N)` lose their SH. A kept row whose SH are all zero joins the SH-less block wherever its rank is;
    it takes no other row's place there.

    Parameters
    ----------
    ranks : np.ndarray
        [N] i64, from `ranks_from_order`.
    choice : Choice
        The rates.
    has_sh : np.ndarray, optional
        [N] bool, false where all SH above degree 0 are zero (`nonzero_sh`). Default: all true.

    Returns
    -------
    tuple of np.ndarray
        Rows with SH and rows without, both [n] i64 ascending.
    """
    if has_sh is not None and len(has_sh) != len(ranks):
        raise InputError(f"has_sh: expected {len(ranks)} rows, got {len(has_sh)}")
    kept = ranks >= choice.pruned(len(ranks))
    with_sh = ranks >= choice.boundary(len(ranks))
    if has_sh is not None:
        with_sh &= has_sh
    return np.flatnonzero(with_sh), np.flatnonzero(kept & ~with_sh)


def nonzero_sh(source: SceneSource, chunk_rows: int = 65536) -> np.ndarray:
    """[N] bool: rows with any SH coefficient above degree 0 that is not zero; read by chunks."""
    found = np.zeros(source.count, bool)
    if source.sh_degree == 0:
        return found
    for start in range(0, source.sh_count, chunk_rows):
        rows = slice(start, min(start + chunk_rows, source.sh_count))
        found[rows] = source.read(rows, ("sh_rest",))["sh_rest"].any(axis=0)
    return found
