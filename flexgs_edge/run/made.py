"""What a method hands back."""

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
    """A finished file: its numbers, how it was found and what it is worth.

    Parameters
    ----------
    size : int
        Bytes.
    count, sh_count, sh_degree : int
        Gaussians, those with SH, and the highest degree.
    choice : Choice
        What was pruned, in thousandths.
    search : SearchResult or None
        `None` where nothing was judged.
    quality : Quality or None
        Of the decoded file, over the views that report.
    trained : float or None
        Fidelity of the decoded file on training poses, dB.
    bits, groups : BitSpec, mapping, or None
        Bits for each attribute and groups for each array (`paper`).
    step_sizes : StepSizes or None
        Of the grid (`best`).
    sensitivity : tuple of Sensitivity
        What `--bits auto` measured.
    scores_reused : bool
        Scores came from the cache.
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
