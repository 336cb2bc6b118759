"""Types of the Python API: paths, arrays, and the options of `compress`."""

import os
from typing import Any, TypedDict

import numpy as np
from numpy.typing import NDArray

StrPath = str | os.PathLike[str]
Floats = NDArray[np.float32]
Numbers = NDArray[np.floating[Any]]


class Arrays(TypedDict):
    """The stored values of N Gaussians: before exp, sigmoid and normalisation.

    `means` is float64 if the scene lies far from zero; otherwise all arrays are float32.
    """

    means: Numbers  # [N, 3], world coordinates
    log_scales: Floats  # [N, 3], natural logarithms of the standard deviations
    quats: Floats  # [N, 4], w x y z, any norm
    opacity_logits: Floats  # [N], opacities before the sigmoid
    sh_dc: Floats  # [N, 3], SH of degree 0
    sh_rest: Floats  # [N, K, 3], SH above degree 0. K is 0, 3, 8, 15 or 24 at SH degree 0 to 4.


class CompressWords(TypedDict, total=False):
    """Single options of `compress`. `flexgs-edge compress --expert` explains each."""

    ignore_distortion: bool
    dataparser: str | None
    exposure: str
    holdout: int
    resolution: int
    near: float | None
    background: tuple[float, float, float] | None
    antialiased: bool | None
    up: tuple[float, float, float] | None
    drop_invalid: bool
    frame: str | None
    lod: int | None
    sh_degree: int | None
    crop: str | None
    memory_limit: int | None
    device: str | None
    method: str
    select: str
    score: str
    score_cache: str | None
    max_drop: float | None
    min_fidelity: float | None
    promise: str
    max_worst_drop: float | str | None
    max_ssim_drop: float | str | None
    max_size: int | None
    min_ratio: float | None
    max_gaussians: int | None
    prune_rate: float | None
    sh_rate: float | None
    bits: str
    groups: int | None
    base_psnr: float | None
    trust_views: bool
    clean: str | None
    keep_removed: str | None
    effort: str
    best_effort: bool
    unseen: str
    views_margin: bool | None
    refit: bool
    distil: int | None
    spz_version: int
    glb: str
    recenter: bool
    force_lossy: bool
    layers: int | None
    preview: int | None
    scratch: str | None
    resume: bool
    report: str | None
    dry_run: bool
    force: bool
