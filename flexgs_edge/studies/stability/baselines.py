"""Baselines: one range for a whole attribute, positions in half precision, and plain scores."""

from __future__ import annotations

import numpy as np

from flexgs_edge.methods.paper.prune import order_from_scores
from flexgs_edge.packed.bitspec import BitSpec
from flexgs_edge.packed.quantize import array_bytes
from flexgs_edge.scene.fields import FIELD, FIELDS
from flexgs_edge.scene.source import MemorySource, SceneSource
from flexgs_edge.studies.study_scene import RANK_BYTES, StudyScene

HALF_LARGEST = float(np.finfo(np.float16).max)
RANGE_BYTES = 8
"""Bytes of a range: its low end and its step."""


def tensor_rounded(source: SceneSource, bits: int) -> tuple[int, MemorySource]:
    """Round to nearest with one range for all channels of an attribute; returns bytes (codes, ranges) and the decoded scene."""
    planes = source.read(slice(0, source.count), list(FIELD))
    size, spec = 0, BitSpec.rtn(bits)
    for field in FIELDS:
        values = planes[field.name]
        if not values.size:
            continue
        low, high = float(values.min()), float(values.max())
        step = (high - low) / (2**bits - 1) or 1.0
        planes[field.name] = (low + np.rint((values.astype(np.float64) - low) / step) * step).astype(np.float32)
        channels = len(values)
        size += array_bytes(source.count, channels, spec.of(field.name), 1) - RANGE_BYTES * (channels - 1)
    # Four zero codes are a quaternion of length zero. The identity takes its place.
    planes["quats"][0, ~planes["quats"].any(axis=0)] = 1.0
    return size, MemorySource(planes, source.sh_degree, source.origin)


def half_positions(source: SceneSource) -> MemorySource:
    """The scene with world positions rounded to half precision, as published programs store them."""
    planes = source.read(slice(0, source.count), list(FIELD))
    world = planes["means"].astype(np.float64) + source.origin[:, None]
    # Infinite values could not be drawn, but saturated ones can.
    half = np.clip(world, -HALF_LARGEST, HALF_LARGEST).astype(np.float16)
    planes["means"] = (half.astype(np.float64) - source.origin[:, None]).astype(np.float32)
    return MemorySource(planes, source.sh_degree, source.origin)


def add_plain_orders(studied: StudyScene, removal: np.ndarray) -> None:
    """Add orders to `studied`: random, by opacity, by volume, and by measured costs of removal ([N] f64)."""
    source = studied.run.source
    studied.run.budget.take("ranks by four more scores", 4 * RANK_BYTES * source.count)
    planes = source.read(slice(0, source.count), ["opacity_logits", "log_scales"])
    studied.orders["random"] = np.random.default_rng(0).permutation(source.count)
    studied.orders["opacity"] = order_from_scores(planes["opacity_logits"][0])
    studied.orders["volume"] = order_from_scores(planes["log_scales"].sum(axis=0, dtype=np.float64))
    studied.orders["dSE"] = order_from_scores(removal)
