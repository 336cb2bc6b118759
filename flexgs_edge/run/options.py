"""The options of the command line as records, checked before any work starts."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from numbers import Integral, Real
from typing import Any

import numpy as np

from flexgs_edge.cameras.camera import split_views
from flexgs_edge.codec.v2.header import PREVIEW_MOST
from flexgs_edge.constants import DEFAULT_BASE_PSNR, DEFAULT_HOLDOUT, MAX_VIEW_WIDTH
from flexgs_edge.errors import InputError, brief
from flexgs_edge.goals.promise import (
    LEAST_SSIM,
    SSIM_PER_DB,
    MadePoses,
    MeanSsim,
    Part,
    WorstView,
    promised,
    worst_allowed,
)
from flexgs_edge.goals.steps import REFINE_STEPS, Choice
from flexgs_edge.goals.target import Figure, MaxDrop, MaxSize, MinFidelity, Target, min_ratio
from flexgs_edge.io.reading import Reading, Writing
from flexgs_edge.packed.bitpack import PAPER, BitSpec
from flexgs_edge.quality.psnr import modelled_drop, mse_of_psnr

NO_PHOTOS = "none"  # `--images none`: do not use the photos beside the scene
AUTO_CAMERAS = "auto"  # `--cameras auto`: generate camera views from the scene itself
NO_CAMERAS = "none"  # `--cameras none`: no views at all. Only fixed rates work then.
METHODS = ("best", "paper")
EFFORT_WORDS = tuple(REFINE_STEPS)
SCORES = ("gs", "meson")
SELECTS = ("test", "train")
EXPOSURES = ("fit", "none")
PROMISES = ("whole", "mean")
GENTLE = "gentle"
CLEANS = (GENTLE, "thorough")
NONE = "none"  # Lifts a bound of the promise
LAYERS_MOST = 4
FINETUNE_MOST = 100_000
"""Most iterations of distillation. This many take hours on any machine; beyond a few thousand nothing is gained."""
DEFAULT_MAX_DROP = 1.0
METHOD_ONLY: dict[str, tuple[str, object]] = {
    "prune_rate": ("paper", None),
    "sh_rate": ("paper", None),
    "score": ("paper", "gs"),
    "score_cache": ("paper", None),
    "bits": ("paper", "paper"),
    "groups": ("paper", None),
    "max_gaussians": ("best", None),
    "unseen": ("best", "keep"),
    "refit": ("best", True),
    "distil": ("best", None),
    "layers": ("best", None),
    "preview": ("best", None),
    "scratch": ("best", None),
    "resume": ("best", False),
}  # Options that only one `--method` knows: the method and the default of each


def check_method(method: str, given: Iterable[str]) -> None:
    """Raise `InputError` if an option in `given` belongs to another method. We never ignore an option silently."""
    for name in given:
        other = METHOD_ONLY[name][0]
        if other != method:
            word = "[no-]refit" if name == "refit" else name.replace("_", "-")
            raise InputError(
                f"--{word} belongs to --method {other}, and this run is --method {method}: "
                f"add --method {other}, or leave --{word} out"
            )


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


KINDS: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "None": ("None", lambda value: value is None),
    "bool": ("True or False", lambda value: isinstance(value, (bool, np.bool_))),
    "int": ("a whole number", lambda value: isinstance(value, Integral) and not isinstance(value, bool)),
    "float": ("a number", _is_number),
    "str": ("a string", lambda value: isinstance(value, (str, os.PathLike))),
    "tuple[float, float, float]": (
        "three numbers",
        lambda value: isinstance(value, (tuple, list, np.ndarray)) and len(value) == 3 and all(map(_is_number, value)),
    ),
}  # What the type of a field stands for in words, and whether a value is of it


def _check_kinds(options: ViewOptions) -> None:
    """Raise `InputError` for a value of another type than that of its field: Python checks none."""
    for field in fields(options):
        kinds = [KINDS[kind] for kind in str(field.type).split(" | ")]
        value = getattr(options, field.name)
        if not any(fits(value) for _, fits in kinds):
            expected = " or ".join(words for words, _ in kinds)
            raise InputError(f"{field.name}={brief(value)}: expected {expected}, found {type(value).__name__}")


@dataclass(frozen=True)
class ViewOptions:
    """Where the views come from, and how they are drawn.

    `flexgs-edge compress --expert` explains every option; `None` stands for its default.
    """

    cameras: str | None = None
    ignore_distortion: bool = False
    dataparser: str | None = None
    images: str | None = None
    exposure: str = "fit"
    holdout: int = DEFAULT_HOLDOUT
    resolution: int = MAX_VIEW_WIDTH
    near: float | None = None
    background: tuple[float, float, float] | None = None
    antialiased: bool | None = None
    up: tuple[float, float, float] | None = None
    drop_invalid: bool = False
    frame: str | None = None
    lod: int | None = None
    sh_degree: int | None = None
    crop: str | None = None
    memory_limit: int | None = None
    device: str | None = None

    def __post_init__(self) -> None:
        _check_kinds(self)
        if self.resolution < 1:
            raise InputError(f"--resolution {self.resolution}: expected a width of at least 1 pixel")
        split_views(0, self.holdout)
        if self.exposure not in EXPOSURES:
            raise InputError(f"--exposure {self.exposure}: expected {' or '.join(EXPOSURES)}")
        if self.near is not None and not 0.0 < self.near < float("inf"):
            raise InputError(f"--near {self.near:g}: expected a distance above 0 in scene units")
        if self.background is not None and not all(0.0 <= c <= 1.0 for c in self.background):
            raise InputError(f"--background {self.background}: expected red, green and blue from 0 to 1")
        if self.up is not None and not (
            len(self.up) == 3 and all(math.isfinite(value) for value in self.up) and any(self.up)
        ):
            raise InputError(f"--up {self.up}: expected three finite numbers, not all zero, such as (0, -1, 0)")
        _ = self.reading

    @property
    def reading(self) -> Reading:
        """How the scene's file is read."""
        return Reading.of(self.frame, self.lod, self.sh_degree, self.crop)


@dataclass(frozen=True)
class CompressOptions(ViewOptions):
    """All options of `compress` besides input and output: see `flexgs-edge compress --expert`.

    `max_size` and `preview` are bytes; `unseen` is a word or a share such as "20%"; `distil` counts iterations.
    """

    method: str = "best"
    select: str = "test"
    score: str = "gs"
    score_cache: str | None = None
    max_drop: float | None = None
    min_fidelity: float | None = None
    promise: str = "whole"
    max_worst_drop: float | str | None = None
    max_ssim_drop: float | str | None = None
    max_size: int | None = None
    min_ratio: float | None = None
    max_gaussians: int | None = None
    prune_rate: float | None = None
    sh_rate: float | None = None
    bits: str = "paper"
    groups: int | None = None
    base_psnr: float | None = None
    trust_views: bool = False
    clean: str | None = None
    keep_removed: str | None = None
    effort: str = "balanced"
    best_effort: bool = False
    unseen: str = "keep"
    views_margin: bool | None = None
    refit: bool = True
    distil: int | None = None
    spz_version: int = 3
    glb: str = "plain"
    recenter: bool = False
    force_lossy: bool = False
    layers: int | None = None
    preview: int | None = None
    scratch: str | None = None
    resume: bool = False
    report: str | None = None
    dry_run: bool = False
    force: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        for word, value, known in (
            ("--method", self.method, METHODS),
            ("--score", self.score, SCORES),
            ("--select", self.select, SELECTS),
            ("--effort", self.effort, EFFORT_WORDS),
            ("--promise", self.promise, PROMISES),
            ("--clean", self.clean or GENTLE, CLEANS),
        ):
            if value not in known:
                raise InputError(f"{word} {value!r}: expected one of {', '.join(known)}")
        if self.base_psnr is not None and not 0.0 < self.base_psnr < 200.0:
            raise InputError(
                f"--base-psnr {self.base_psnr:g}: expected decibels between 0 and 200 (most scenes: 22 to 36)"
            )
        if self.max_gaussians is not None and self.max_gaussians < 1:
            raise InputError(f"--max-gaussians {self.max_gaussians}: expected 1 or more")
        if self.groups is not None and self.groups < 1:
            raise InputError(f"--groups {self.groups}: expected 1 or more")
        check_method(self.method, [name for name in METHOD_ONLY if getattr(self, name) != METHOD_ONLY[name][1]])
        if not self.refit and self.distil:
            raise InputError(
                f"--no-refit with --distil {self.distil}: distilling is the larger refit; give one or the other"
            )
        if self.distil is not None and not 0 <= self.distil <= FINETUNE_MOST:
            raise InputError(f"--distil {self.distil}: expected 0 (none) to {FINETUNE_MOST} steps")
        if self.layers is not None and not 1 <= self.layers <= LAYERS_MOST:
            raise InputError(f"--layers {self.layers}: expected 1 to {LAYERS_MOST}")
        if self.preview is not None and not 0 <= self.preview <= PREVIEW_MOST:
            raise InputError(f"--preview {self.preview}: expected 0 (none) to {PREVIEW_MOST} bytes")
        if self.keep_removed is not None and self.clean is None:
            raise InputError(
                "--keep-removed: nothing is removed without --clean: give it too, or leave --keep-removed out"
            )
        _ = self.writing
        self._check_targets()
        self.bit_spec()
        _ = self.unseen_share

    def _check_targets(self) -> None:
        given = self.targets
        if len(given) > 1:
            raise InputError(f"{' and '.join(given)}: give one target")
        if (self.prune_rate is None) != (self.sh_rate is None):
            raise InputError("--prune-rate and --sh-rate: give both (fixed rates, no search) or none")
        if self.fixed is not None and given:
            raise InputError(
                f"{given[0]} with --prune-rate and --sh-rate: fixed rates leave nothing to search; give one or the other"
            )
        for word, bound in (("--max-worst-drop", self.max_worst_drop), ("--max-ssim-drop", self.max_ssim_drop)):
            if isinstance(bound, str) and bound != NONE:
                raise InputError(f"{word} {bound}: expected a number or none")
            if bound is not None and self.fixed is not None:
                raise InputError(f"{word} with --prune-rate and --sh-rate: fixed rates leave nothing to search")
        self.target("drop", 1)

    @property
    def targets(self) -> list[str]:
        """The targets that the user named, as words of the command line; empty: the default decides."""
        words = ("max_drop", "min_fidelity", "max_size", "min_ratio")
        return ["--" + word.replace("_", "-") for word in words if getattr(self, word) is not None]

    @property
    def target_is_default(self) -> bool:
        """Whether the user named no target and no bound of the promise."""
        return not self.targets and self.max_worst_drop in (None, NONE) and self.max_ssim_drop in (None, NONE)

    @property
    def finetunes(self) -> bool:
        """Whether results are fine-tuned to the views, unless they are too small or too large for it."""
        return (
            self.method == "best" and self.refit and (self.effort != "fast" if self.distil is None else self.distil > 0)
        )

    @property
    def takes_closest(self) -> bool:
        """Whether the closest result is written if none holds: who named no target wants a file all the same."""
        return self.best_effort or self.target_is_default

    @property
    def makes_poses(self) -> bool:
        """Whether made poses are scored and bounded."""
        return self.promise == "whole" if self.views_margin is None else self.views_margin

    @property
    def writing(self) -> Writing:
        """How a file of another program's format is written."""
        return Writing(self.spz_version, bool(self.antialiased), self.force_lossy, self.glb)

    @property
    def unseen_share(self) -> float:
        """Share, from 0 to 1, of the unseen Gaussians to keep."""
        word = self.unseen.strip().lower()
        if word in ("keep", "drop"):
            return float(word == "keep")
        try:
            share = float(word.removesuffix("%")) / 100 if word.endswith("%") else math.nan
        except ValueError:
            share = math.nan
        if not 0.0 <= share <= 1.0:
            raise InputError(f"--unseen {self.unseen}: expected keep, drop, or a share from 0% to 100%")
        return share

    @property
    def fixed(self) -> Choice | None:
        """The fixed rates; `None` if a search is asked for."""
        if self.prune_rate is None or self.sh_rate is None:
            return None
        choice = Choice.from_rates(self.prune_rate, self.sh_rate)
        if choice.prune == 1000:
            raise InputError(f"--prune-rate {self.prune_rate:g}: expected less than 1: nothing would be left to draw")
        return choice

    def target(self, figure: Figure, ply_bytes: int) -> Target | None:
        """The target of the search, or `None` for fixed rates. `figure` is the kind of drop that decides."""
        if self.fixed is not None:
            return None
        target: Target
        allowed: float | None = None
        if self.max_size is not None:
            target = MaxSize(self.max_size, figure)
        elif self.min_ratio is not None:
            target = min_ratio(self.min_ratio, ply_bytes, figure)
        elif self.min_fidelity is not None:
            target = MinFidelity(self.min_fidelity)
            allowed = modelled_drop(mse_of_psnr(self.min_fidelity), self.base_psnr or DEFAULT_BASE_PSNR)
        else:
            allowed = DEFAULT_MAX_DROP if self.max_drop is None else self.max_drop
            target = MaxDrop(allowed, figure)
        return promised(target, self._parts(figure, allowed))

    def _parts(self, figure: Figure, allowed: float | None) -> list[Part]:
        """The bounds beside the target; `allowed` is the drop that the target allows, dB, if it says so."""
        parts: list[Part] = []
        whole = self.promise == "whole"
        if isinstance(self.max_worst_drop, (int, float)):
            parts.append(WorstView(figure, self.max_worst_drop))
        elif whole and self.max_worst_drop is None:
            parts.append(WorstView(figure, None if allowed is None else worst_allowed(allowed)))
        if isinstance(self.max_ssim_drop, (int, float)):
            parts.append(MeanSsim(self.max_ssim_drop))
        elif whole and self.max_ssim_drop is None and allowed is not None:
            parts.append(MeanSsim(max(SSIM_PER_DB * allowed, LEAST_SSIM)))
        if self.makes_poses:
            parts.append(MadePoses())
        return parts

    def bit_spec(self) -> tuple[BitSpec, int | None]:
        """Bits and groups that `--bits` and `--groups` ask for."""
        words = self.bits.strip().lower()
        if words == "paper":
            return PAPER, self.groups
        if words.startswith("rtn"):
            if not words[3:].isdigit():
                raise InputError(f"--bits {self.bits}: expected rtn and a number of bits, such as rtn8")
            return BitSpec.rtn(int(words[3:])), 1 if self.groups is None else self.groups
        return BitSpec.parse(self.bits), self.groups
