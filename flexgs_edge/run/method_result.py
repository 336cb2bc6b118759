"""The record that a method returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from flexgs_edge.goals.steps import Choice, SearchResult
from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.packed.bitspec import BitSpec
from flexgs_edge.quality.view_quality import Quality


@dataclass(frozen=True)
class MethodResult:
    """A finished file: its size, the search that found it, and its quality.

    `count`, `sh_count`, `sh_degree`: Gaussians, those with SH above degree 0, and the highest SH degree.
    """

    size: int  # bytes of the file
    count: int
    sh_count: int
    sh_degree: int
    choice: Choice  # prune rate and SH rate, in thousandths
    search: SearchResult | None  # every step of the search; `None` for fixed rates
    quality: Quality | None  # quality of the decoded file over the report views; `None` without views
    trained: float | None  # fidelity of the decoded file on training views, dB; `None` if not measured
    bits: BitSpec | None = None  # bits per attribute (`paper`)
    groups: Mapping[str, int] | None = None  # quantization groups per array (`paper`)
    step_sizes: StepSizes | None = None  # quantization step sizes (`best`)
    scores_reused: bool = False  # whether the scores came from the cache
    preview_bytes: int = 0  # bytes of the file that are its preview (`best`); 0 if it has none
