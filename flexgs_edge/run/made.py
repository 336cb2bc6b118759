"""The record that a method returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from flexgs_edge.goals.choice import Choice
from flexgs_edge.goals.steps import SearchResult
from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.packed.bitspec import BitSpec
from flexgs_edge.packed.sensitivity import Sensitivity
from flexgs_edge.quality.view_quality import Quality


@dataclass(frozen=True)
class Made:
    """A finished file: its size, the search that found it, and its quality.

    Parameters
    ----------
    size : int
        Bytes of the file.
    count, sh_count, sh_degree : int
        Gaussians, those with SH above degree 0, and the highest SH degree.
    choice : Choice
        Prune rate and SH rate, in thousandths.
    search : SearchResult or None
        Every step of the search; `None` for fixed rates.
    quality : Quality or None
        Quality of the decoded file over the report views; `None` without views.
    trained : float or None
        Fidelity of the decoded file on training views, dB; `None` if not measured.
    bits : BitSpec or None
        Bits per attribute (`paper`).
    groups : mapping or None
        Quantization groups per array (`paper`).
    step_sizes : StepSizes or None
        Quantization step sizes (`best`).
    sensitivity : tuple of Sensitivity
        Loss per attribute and bit width, as `--bits auto` measured it.
    scores_reused : bool
        Whether the scores came from the cache.
    preview_bytes : int
        Bytes of the file that are its preview (`best`); 0 if it has none.
    """

    size: int
    count: int
    sh_count: int
    sh_degree: int
    choice: Choice
    search: SearchResult | None
    quality: Quality | None
    trained: float | None
    bits: BitSpec | None = None
    groups: Mapping[str, int] | None = None
    step_sizes: StepSizes | None = None
    sensitivity: tuple[Sensitivity, ...] = ()
    scores_reused: bool = False
    preview_bytes: int = 0
