"""Merge neighbours into one Gaussian each: a scene in far fewer, at once and without a view."""

import numpy as np

from flexgs_edge.scene.rotations import matrices, quats_of
from flexgs_edge.scene.source import Planes

GROUPS = 4096  # Groups that are merged at a time
MOST_OPACITY = 0.99


def merged(planes: Planes, order: np.ndarray, size: int) -> Planes:
    """Merge each `size` rows that follow each other in `order` ([n] i64) into one, by their moments, without SH.

    The merged Gaussian has the mean and the covariance of the whole group, the mean of its colours, and the light that its
    rows hold back. Each row counts by its opacity times the area of its two longest axes.

    `planes`: stored planes ([width, n] f32 by field). `order`: neighbours in space one after the other.
    """
    count, groups = len(order), -(-len(order) // size)
    small = {name: np.empty((values.shape[0], groups), np.float32) for name, values in planes.items()}
    small["sh_rest"] = small["sh_rest"][:0]
    for first in range(0, groups, GROUPS):
        stop = min(first + GROUPS, groups)
        rows = order[first * size : min(stop * size, count)]
        part = {name: planes[name][:, rows].astype(np.float64) for name in small if name != "sh_rest"}
        for name, values in _merged(part, size).items():
            small[name][:, first:stop] = values
    return small


def _merged(planes: Planes, size: int) -> Planes:
    count = planes["means"].shape[1]
    groups = -(-count // size)

    def grouped(values: np.ndarray) -> np.ndarray:
        """[groups, size, ...] of [n, ...], with zeros behind the last row."""
        filled = np.zeros((groups * size, *values.shape[1:]))
        filled[:count] = values
        return filled.reshape(groups, size, *values.shape[1:])

    scales = np.exp(planes["log_scales"])
    longest = np.sort(scales, axis=0)[1:]
    light = longest[0] * longest[1] / (1 + np.exp(-planes["opacity_logits"][0]))
    weights = grouped(np.maximum(light, np.finfo(np.float32).tiny))
    weights /= weights.sum(axis=1, keepdims=True)
    means, colours = grouped(planes["means"].T), grouped(planes["sh_dc"].T)
    mean = np.einsum("gk,gki->gi", weights, means)
    axes = matrices(planes["quats"]) * scales.T[:, None]
    apart = means - mean[:, None]
    spread = np.einsum("gk,gki,gkj->gij", weights, apart, apart, optimize=True)
    own = grouped(np.einsum("nij,nkj->nik", axes, axes))
    lengths, turns = np.linalg.eigh(spread + np.einsum("gk,gkij->gij", weights, own))
    turns[:, :, 0] *= np.linalg.det(turns)[:, None]  # a rotation, not a reflection
    lengths = np.sqrt(np.maximum(lengths, lengths[:, 2:] * 1e-8))
    opacity = np.minimum(grouped(light).sum(axis=1) / (lengths[:, 1] * lengths[:, 2]), MOST_OPACITY)
    return {
        "means": mean.T,
        "log_scales": np.log(lengths).T,
        "quats": quats_of(turns),
        "opacity_logits": np.log(opacity / (1 - opacity))[None],
        "sh_dc": np.einsum("gk,gki->gi", weights, colours).T,
    }
