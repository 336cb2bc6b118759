"""Palettes of SH: a limited number of vectors that stand for those of all rows.

Vectors become whole numbers first, so small that float32 holds all their products and sums exactly. Every machine and
every library of linear algebra then finds the same palette.
"""

from collections.abc import Iterator

import numpy as np

from flexgs_edge.memory.rows import blocks

_BINS = 1024
_ROUNDS = 10
_LARGEST = 511  # Largest whole number: 45 squares of it, and any part of their sum, stay below 2^24
_CLIP = 16.0  # Coefficients beyond this many root mean squares are clipped while vectors are compared
_FINE = 4096  # Parts of a whole number that means keep
_GROUP = 256
_CANDIDATES = 1536
"""Vectors are divided into groups of about the first number. Each is compared with those of the nearest groups, about the
second number."""
_SHARE = 0.15
"""Largest part of the clusters that is merged at a time. Smaller parts give better palettes, and take longer."""
_SAMPLE = 4  # Vectors that clusters are merged from, for each entry of the palette
_PASSES = 4  # Passes in which vectors choose the best entry near theirs, and entries move to the mean of their vectors
_BLOCK = 1 << 21  # Products held at a time
_ROWS = 65536  # Rows whose values are rounded, or added up, at a time


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


def sh_palette(values: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Find a palette of vectors with little squared error.

    Clusters are merged in pairs, those that lose least first (Ward's method), until `most` are left; a few passes of
    k-means follow. Vectors of zeros get an entry of zeros. Entries are in the order in which rows use them first, so
    that labels grow slowly, which costs few bits.

    `values`: [n, d] finite f32, d at most 45.

    Returns [n] i64, the entry of each row, and [entries, d] f32.
    """
    step = _step(values)
    whole = np.empty(values.shape, np.int16)
    for part in blocks(len(values), _ROWS):
        whole[part] = np.clip(np.rint(values[part] / step), -_LARGEST, _LARGEST)
    points, inverse, counts = np.unique(whole, axis=0, return_inverse=True, return_counts=True)
    del whole
    labels = np.arange(len(points))
    if len(points) > most:
        lit = points.any(axis=1)
        labels = np.full(len(points), -1)
        labels[lit] = _clusters(points[lit].astype(np.float32), counts[lit], most - int(not lit.all()))
        labels[~lit] = labels.max() + 1
    rows = _by_first_use(labels[inverse.reshape(-1)])
    palette = _fine_means(values, rows, step)
    dark = np.flatnonzero(~points.any(axis=1))
    palette[rows[np.isin(inverse.reshape(-1), dark)]] = 0
    return rows, palette


def _by_first_use(labels: np.ndarray) -> np.ndarray:
    """The same labels, numbered in the order in which they first occur."""
    _, first, numbers = np.unique(labels, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return np.asarray(rank[numbers.reshape(-1)])


def _step(values: np.ndarray) -> np.float32:
    """The size of a whole number: a power of two, so that rounding in a sum cannot change it but for rare chance."""
    square = sum(float(np.square(values[part], dtype=np.float64).sum()) for part in blocks(len(values), _ROWS))
    largest = max((float(np.abs(values[part]).max(initial=0)) for part in blocks(len(values), _ROWS)), default=0.0)
    reach = min(largest, _CLIP * float(np.sqrt(square / max(values.size, 1))))
    return np.float32(2.0 ** np.ceil(np.log2(reach / _LARGEST))) if reach > 0 else np.float32(1)


def _fine_means(values: np.ndarray, rows: np.ndarray, step: np.float32) -> np.ndarray:
    """[entries, d] f32, the means of the rows of each entry."""
    counts = np.bincount(rows)
    means = np.empty((len(counts), values.shape[1]), np.float32)
    for channel in range(values.shape[1]):
        fine = np.rint(values[:, channel].astype(np.float64) * (_FINE / float(step)))
        means[:, channel] = np.bincount(rows, fine) / counts * (float(step) / _FINE)
    return means


def _clusters(points: np.ndarray, weights: np.ndarray, most: int) -> np.ndarray:
    """[m] i64, the cluster of each of m different points ([m, d] f32, whole numbers); at most `most` clusters."""
    size = min(len(points), _SAMPLE * most)
    sample = np.arange(size) * len(points) // size
    centres = _centres(points[sample])
    labels, entries, homes = _merged(points[sample], weights[sample], centres, most)
    if size < len(points):
        labels = _closest(points, centres)  # the nearest group, in which the nearest entry is looked for
        labels = _nearest_entries(points, labels, entries, homes, centres)
    for _ in range(_PASSES):
        labels = _nearest_entries(points, homes[labels], entries, homes, centres)
        entries = _means(points, weights, labels, entries)
    return labels


def _merged(
    points: np.ndarray, weights: np.ndarray, centres: np.ndarray, most: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Merge points in pairs until `most` clusters are left.

    Returns [m] i64, the cluster of each point; [most, d] f32, their means in whole numbers; [most] i64, their groups.
    """
    labels, entries, heavy, homes = np.arange(len(points)), points, weights, _closest(points, centres)
    while len(entries) > most:
        partners, losses = _nearest_partners(entries, heavy, homes, centres)
        wanted = min(len(entries) - most, max(int(_SHARE * len(entries)), 1))
        to = _pairs(partners, losses, wanted)
        kept = to == np.arange(len(entries))
        labels = (np.cumsum(kept) - 1)[to][labels]
        homes = homes[kept]
        entries = _means(points, weights, labels, entries[kept])
        heavy = np.bincount(labels, weights)
    return labels, entries, homes


def _pairs(partners: np.ndarray, losses: np.ndarray, wanted: int) -> np.ndarray:
    """[m] i64, the point that each is merged into, or itself: the pairs of least loss, each point in one pair at most."""
    to, free = list(range(len(partners))), [True] * len(partners)
    for one in np.argsort(losses, kind="stable").tolist():
        other = int(partners[one])
        if free[one] and free[other]:
            free[one] = free[other] = False
            to[max(one, other)] = min(one, other)
            wanted -= 1
            if not wanted:
                break
    return np.array(to)


def _nearest_partners(
    entries: np.ndarray, weights: np.ndarray, homes: np.ndarray, centres: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The partner of each entry that loses least if both are merged, among those near it, and the loss."""
    partners, losses = np.zeros(len(entries), np.int64), np.full(len(entries), np.inf, np.float32)
    squares = np.einsum("ij,ij->i", entries, entries)
    light = (1 / weights).astype(np.float32)
    place = np.zeros(len(entries), np.int64)
    for members, near in _neighbourhoods(homes, homes, centres):
        place[near] = np.arange(len(near))
        for part in blocks(len(members), max(_BLOCK // len(near), 1)):
            some = members[part]
            loss = (squares[some, None] + squares[near]) - 2 * (entries[some] @ entries[near].T)
            loss /= light[some, None] + light[near]
            line = np.arange(len(some))
            loss[line, place[some]] = np.inf  # not itself
            best = loss.argmin(axis=1)
            partners[some], losses[some] = near[best], loss[line, best]
    return partners, losses


def _nearest_entries(
    points: np.ndarray, groups: np.ndarray, entries: np.ndarray, homes: np.ndarray, centres: np.ndarray
) -> np.ndarray:
    """[m] i64, the nearest entry of each point, among those near its group."""
    labels = np.zeros(len(points), np.int64)
    for members, near in _neighbourhoods(groups, homes, centres):
        for part in blocks(len(members), max(_BLOCK // len(near), 1)):
            some = members[part]
            labels[some] = near[_closest(points[some], entries[near])]
    return labels


def _neighbourhoods(
    groups: np.ndarray, homes: np.ndarray, centres: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the points of each group, and the entries of this group and those nearest to it."""
    lists, members = _by_group(homes, len(centres)), _by_group(groups, len(centres))
    width = min(len(centres), max(2, _CANDIDATES * len(centres) // max(len(homes), 1)))
    squares = np.einsum("ij,ij->i", centres, centres)
    for group, rows in enumerate(members):
        if len(rows):
            distance = squares / 2 - centres @ centres[group]
            distance[group] = -np.inf
            nearest = np.argsort(distance, kind="stable")[:width]
            near = np.concatenate([lists[other] for other in nearest])
            if len(near):
                yield rows, near


def _by_group(groups: np.ndarray, count: int) -> list[np.ndarray]:
    order = np.argsort(groups, kind="stable")
    return np.split(order, np.cumsum(np.bincount(groups, minlength=count))[:-1])


def _centres(points: np.ndarray) -> np.ndarray:
    """[g, d] f32, centres of groups, whole numbers, by k-means over a part of the points."""
    count = max(len(points) // _GROUP, 1)
    size = min(len(points), 16 * count)
    some = points[np.arange(size) * len(points) // size]
    centres = some[np.arange(count) * size // count]
    for _ in range(3):
        centres = _means(some, np.ones(size), _closest(some, centres), centres)
    return centres


def _closest(points: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """[m] i64, the nearest centre of each point, by exact products."""
    half = np.einsum("ij,ij->i", centres, centres) / 2
    labels = np.empty(len(points), np.int64)
    for part in blocks(len(points), max(_BLOCK // len(centres), 1)):
        labels[part] = (points[part] @ centres.T - half).argmax(axis=1)
    return labels


def _means(points: np.ndarray, weights: np.ndarray, labels: np.ndarray, before: np.ndarray) -> np.ndarray:
    """[k, d] f32, the weighted mean of each cluster in whole numbers; `before` where it has no points."""
    heavy = np.bincount(labels, weights, minlength=len(before))
    means = before.copy()
    some = heavy > 0
    for channel in range(points.shape[1]):
        sums = np.bincount(labels, weights * points[:, channel].astype(np.float64), minlength=len(before))
        means[some, channel] = np.rint(sums[some] / heavy[some])
    return means
