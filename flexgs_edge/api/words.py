"""Types of the Python API: paths, arrays, and the words of `compress`."""

from __future__ import annotations

import os
from typing import Any, TypedDict

import numpy as np
from numpy.typing import NDArray

StrPath = str | os.PathLike[str]
Floats = NDArray[np.float32]
Numbers = NDArray[np.floating[Any]]


class Arrays(TypedDict):
    """The stored values of N Gaussians: before exp, sigmoid and normalisation.

    `means` is float64 where the scene is far from zero, else float32 as all others are.
    """

    means: Numbers
    """[N, 3], world."""
    log_scales: Floats
    """[N, 3]."""
    quats: Floats
    """[N, 4], w x y z, any norm."""
    opacity_logits: Floats
    """[N]."""
    sh_dc: Floats
    """[N, 3]."""
    sh_rest: Floats
    """[N, K, 3] with K = 0, 3, 8, 15 or 24 at SH degree 0 to 4."""


class CompressWords(TypedDict, total=False):
    """Single options of `compress`, as `CompressOptions` explains them."""

    ignore_distortion: bool
    holdout: int
    resolution: int
    near: float | None
    background: tuple[float, float, float] | None
    extent: str | None
    antialiased: bool | None
    drop_invalid: bool
    memory_limit: int | None
    device: str | None
    method: str
    select: str
    score: str
    save_scores: str | None
    score_cache: str | None
    max_drop: float | None
    min_fidelity: float | None
    max_worst_drop: float | None
    max_size: int | None
    min_ratio: float | None
    prune_rate: float | None
    sh_rate: float | None
    bits: str
    groups: int | None
    base_psnr: float
    effort: str
    best_effort: bool
    unseen: str
    views_margin: bool
    refit: bool
    distil: int | None
    layers: int
    scratch: str | None
    resume: bool
    cluster: str | None
    report: str | None
    dry_run: bool
    force: bool
