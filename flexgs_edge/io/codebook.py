"""Codebooks of single numbers: the 256 values that stand for many with the least squared error.

Dynamic programming over a histogram finds the best cuts, and a few rounds of Lloyd's algorithm move them between the
histogram's edges. All sums run in one order, so that every machine finds the same values.
"""

from __future__ import annotations

import numpy as np

_BINS = 1024
_ROUNDS = 10


def best_codebook(values: np.ndarray, weights: np.ndarray | None = None, size: int = 256) -> np.ndarray:
    """[at most size] f64, ascending, rounded to float32: the values that stand for `values` best.

    `values`: [n] finite f32; at least one. `weights`: [n], how much the error of each counts; 1 by default. `size`:
    most values.
    """
    order = np.argsort(values, kind="stable")
    ordered = values[order].astype(np.float64)
    heavy = np.ones(len(ordered)) if weights is None else weights[order].astype(np.float64)
    first = np.flatnonzero(np.diff(ordered, prepend=-np.inf))
    if len(first) <= size:
        return ordered[first]
    middle = ordered[len(ordered) // 2]  # squares of differences keep more digits than those of far values
    sums = _Sums(ordered - middle, heavy)
    edges = _bin_edges(ordered, first)
    cuts = edges[_best_cuts(sums, edges, size)]
    for _ in range(_ROUNDS):
        centres = sums.mean(cuts)
        moved = np.concatenate(
            [[0], np.searchsorted(ordered - middle, (centres[1:] + centres[:-1]) / 2), [len(ordered)]]
        )
        if np.array_equal(moved, cuts) or not np.all(np.diff(moved)):
            break
        cuts = moved
    return np.unique((sums.mean(cuts) + middle).astype(np.float32)).astype(np.float64)


def nearest_codes(codebook: np.ndarray, values: np.ndarray) -> np.ndarray:
    """u8, the places in an ascending codebook of at most 256 values that are nearest to values of any shape."""
    return np.searchsorted((codebook[1:] + codebook[:-1]) / 2, values).astype(np.uint8)


class _Sums:
    """Sums of ordered values over ranges, and what a range loses if one value stands for it."""

    def __init__(self, ordered: np.ndarray, weights: np.ndarray) -> None:
        # cumsum adds one by one, which gives the same digits everywhere.
        self.weight, self.first, self.second = (
            np.concatenate([[0.0], np.cumsum(weights * power)]) for power in (1.0, ordered, ordered * ordered)
        )

    def mean(self, cuts: np.ndarray) -> np.ndarray:
        """The best value of each range between cuts."""
        return np.asarray(np.diff(self.first[cuts]) / np.diff(self.weight[cuts]))

    def loss(self, start: np.ndarray, stop: np.ndarray) -> np.ndarray:
        """Squared error of ranges that one value stands for; infinite for empty ranges."""
        weight, first = self.weight[stop] - self.weight[start], self.first[stop] - self.first[start]
        some = weight > 0
        loss = self.second[stop] - self.second[start] - first * first / np.where(some, weight, 1)
        return np.where(some, np.maximum(loss, 0), np.inf)


def _bin_edges(ordered: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Places where bins begin, and the end.

    A third of the bins have equal counts, a third equal numbers of distinct values (which begin at `first`), and a third
    equal widths: rare values far away, and many equal ones, leave enough bins for the others.
    """
    shares = np.arange(_BINS // 3)
    counts = ordered[shares * len(ordered) // len(shares)]
    widths = ordered[0] + (ordered[-1] - ordered[0]) * (shares / len(shares))
    distinct = first[shares * len(first) // len(shares)]
    return np.unique(
        np.concatenate([np.searchsorted(ordered, np.concatenate([counts, widths])), distinct, [len(ordered)]])
    )


def _best_cuts(sums: _Sums, edges: np.ndarray, size: int) -> np.ndarray:
    """[size + 1] i64, places in `edges` that cut the bins into `size` ranges of least loss in all."""
    bins = len(edges) - 1
    losses = sums.loss(np.zeros(bins, np.int64), edges[1:])
    choices = []
    for count in range(2, size + 1):
        losses, choice = _one_more(sums, edges, losses, count)
        choices.append(choice)
    cuts = [bins]
    for choice in reversed(choices):
        cuts.append(int(choice[cuts[-1] - 1]))
    return np.array([0, *reversed(cuts)])


def _one_more(sums: _Sums, edges: np.ndarray, losses: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The least losses of the first 1, 2, ... bins in `count` ranges, and where the last of these begins.

    `losses` are those in `count - 1` ranges. The best beginning never moves left when bins are added, so we ask for every
    second end first, and for those in between within the bounds that their neighbours give.
    """
    bins = len(losses)
    best, choice = np.full(bins, np.inf), np.full(bins, bins - 1)
    low, high = np.full(bins + 1, count - 1), np.full(bins + 1, bins - 1)
    ends = np.arange(bins)
    step = 1 << (bins - 1).bit_length()
    while step:
        here = ends[step - 1 :: 2 * step]
        here = here[here >= count - 1]
        if len(here):
            first, last = low[here], np.minimum(high[here], here)
            lengths = last - first + 1
            starts = np.cumsum(lengths) - lengths
            begin = np.arange(lengths.sum()) - np.repeat(starts - first, lengths)
            total = losses[begin - 1] + sums.loss(edges[begin], np.repeat(edges[here + 1], lengths))
            least = np.minimum.reduceat(total, starts)
            hits = np.flatnonzero(total == np.repeat(least, lengths))
            taken = hits[np.searchsorted(hits, starts)]
            best[here], choice[here] = least, begin[taken]
        step //= 2
        if step:  # bounds for the ends that come next, from those that are known
            between = ends[step - 1 :: 2 * step]
            left = np.where(between - step >= count - 1, choice[np.maximum(between - step, 0)], count - 1)
            right = np.where(between + step < bins, choice[np.minimum(between + step, bins - 1)], bins - 1)
            low[between], high[between] = left, right
    return best, choice
