"""Baselines: plain scores."""

from __future__ import annotations

import numpy as np

from flexgs_edge.methods.paper.prune import order_from_scores
from flexgs_edge.studies.study_scene import RANK_BYTES, StudyScene


def add_plain_orders(studied: StudyScene, removal: np.ndarray) -> None:
    """Add orders to `studied`: random, by opacity, by volume, and by measured costs of removal ([N] f64)."""
    source = studied.run.source
    studied.run.budget.take("ranks by four more scores", 4 * RANK_BYTES * source.count)
    planes = source.read(slice(0, source.count), ["opacity_logits", "log_scales"])
    studied.orders["random"] = np.random.default_rng(0).permutation(source.count)
    studied.orders["opacity"] = order_from_scores(planes["opacity_logits"][0])
    studied.orders["volume"] = order_from_scores(planes["log_scales"].sum(axis=0, dtype=np.float64))
    studied.orders["dSE"] = order_from_scores(removal)
