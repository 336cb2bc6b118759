"""Attribute-discriminative pruning (ADP): some rows are removed, others lose only their SH.

Source: FlexGaussian (ACM MM 2025), section on ADP. Rates are integers in thousandths of N, so that one choice means the
same rows on every machine.
"""

import numpy as np

from flexgs_edge.errors import InputError
from flexgs_edge.goals.steps import Choice
from flexgs_edge.memory.rows import blocks
from flexgs_edge.scene.source import SceneSource


def order_from_scores(scores: np.ndarray) -> np.ndarray:
    """Rows from the least to the most important; ties by index.

    `scores`: [N] f64; infinities are allowed. Returns [N] i64. Raises `InputError` when a score is NaN, because its
    place would depend on the sort.
    """
    scores = np.asarray(scores, np.float64)
    if scores.ndim != 1:
        raise InputError(f"scores: expected one number a row, got an array of shape {scores.shape}")
    bad = np.flatnonzero(np.isnan(scores))
    if len(bad):
        raise InputError(f"scores: {len(bad)} of {len(scores)} are NaN, the first at row {bad[0]}: expected numbers")
    return np.argsort(scores, kind="stable").astype(np.int64, copy=False)


def ranks_from_order(order: np.ndarray) -> np.ndarray:
    """[N] i64, rank of every row (0 is the least important): the inverse of the permutation `order`."""
    ranks = np.empty(len(order), np.int64)
    ranks[order] = np.arange(len(order), dtype=np.int64)
    return ranks


def select_rows(ranks: np.ndarray, choice: Choice, has_sh: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Rows that stay, in two blocks, each in input order.

    Rates count over all N rows, as in the paper. The `choice.pruned(N)` lowest ranks are removed, and ranks up to
    `choice.boundary(N)` lose their SH. A kept row whose SH are all zero joins the block without SH, whatever its rank;
    it takes no other row's place there.

    `ranks`: [N] i64, from `ranks_from_order`. `choice`: the rates. `has_sh`: [N] bool, false where all SH above degree
    0 are zero (`nonzero_sh`). Default: all true. Returns rows with SH and rows without, both [n] i64 ascending.
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
    for rows in blocks(source.sh_count, chunk_rows):
        found[rows] = source.read(rows, ("sh_rest",))["sh_rest"].any(axis=0)
    return found
