"""One record a job: what the summary prints, `--json` writes and the tests read.

Keys of the JSON are the field names below unless a docstring says otherwise; sizes are bytes, times seconds (where the name
ends in `_ms`, milliseconds), quality dB. null stands for "identical" (PSNRs and fidelity) or "nothing to measure"
(photos, targets).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

from flexgs_edge._version import __version__
from flexgs_edge.goals.steps import Scored, SearchResult
from flexgs_edge.packed.sensitivity import Sensitivity
from flexgs_edge.quality.view_quality import Quality
from flexgs_edge.report.as_json import quality_json, rounded, step_json
from flexgs_edge.report.run_info import RunInfo, SceneInfo, ViewsInfo


@dataclass(frozen=True)
class CompressResult:
    """What `compress` did.

    Parameters
    ----------
    scene, views : SceneInfo, ViewsInfo or None
        What went in (`views` is None for a run without cameras).
    output : str or None
        File written; `None` in a dry run.
    size : int
        Bytes of the file (in a dry run: that it would have; the size model is exact).
    count, sh_count : int
        Gaussians kept, and of these with SH.
    prune_rate, sh_rate : float
        The choice.
    method, score, select : str
        As asked for.
    bits : dict
        Bits by attribute.
    groups : dict
        Groups per channel by attribute.
    steps : dict or None
        Grid steps by attribute (`--method best`, which has no bits and groups).
    target : str or None
        The target in words; `None` for fixed rates.
    decided_by : str or None
        `drop`, `modelled drop`, `fidelity` or `size`; `None` for fixed rates.
    reached : bool or None
        Whether the target holds at the decision.
    decision_views : str
        Which views decided: `held-out`, `training` or `none`.
    search : SearchResult or None
        Every step of the search.
    sensitivity : tuple of Sensitivity
        What `--bits auto` measured.
    quality : Quality or None
        Of the decoded file, over `quality_views` (`None` without cameras).
    quality_views : str
        `held-out`, `training` or `none`.
    scores_saved : str or None
        File of scores written.
    score_cache : str or None
        File that keeps the scores between runs.
    scores_reused : bool
        Whether they were taken from it.
    run : RunInfo
        Times, memory, device.
    format : str
        `fgs`, `spz`, `sog` or `compressed.ply`.
    file_sh_degree : int or None
        SH degree of the file.
    scored : Scored or None
        Poses and unseen Gaussians of a search by measured costs.
    training_fidelity : float or None
        Fidelity of the decoded file on some training poses, where `quality` is of held-out views.
    warnings : tuple of str
        Reasons to trust the figures less, each with a number.
    """

    scene: SceneInfo
    views: ViewsInfo | None
    output: str | None
    size: int
    count: int
    sh_count: int
    prune_rate: float
    sh_rate: float
    method: str
    score: str | None
    select: str
    bits: dict[str, int]
    groups: dict[str, int]
    steps: dict[str, Any] | None
    target: str | None
    decided_by: str | None
    reached: bool | None
    decision_views: str
    search: SearchResult | None
    sensitivity: tuple[Sensitivity, ...]
    quality: Quality | None
    quality_views: str
    scores_saved: str | None
    score_cache: str | None
    scores_reused: bool
    run: RunInfo
    format: str = "fgs"
    file_sh_degree: int | None = None
    scored: Scored | None = None
    training_fidelity: float | None = None
    warnings: tuple[str, ...] = ()

    @property
    def ratio(self) -> float:
        """PLY bytes, as INRIA writes them, for each byte of the file."""
        return self.scene.ply_bytes / self.size

    @property
    def ratio_without_normals(self) -> float:
        """The same for a PLY without normals."""
        return self.scene.ply_bytes_without_normals / self.size

    def to_json(self) -> dict[str, Any]:
        """The record for machines."""
        return {
            "program": f"flexgs-edge {__version__}",
            "command": "compress",
            "input": self.scene.to_json(),
            "views": self.views.to_json() if self.views else None,
            "output": self.output,
            "format": self.format,
            "file_sh_degree": self.file_sh_degree,
            "size": self.size,
            "ratio": round(self.ratio, 4),
            "ratio_without_normals": round(self.ratio_without_normals, 4),
            "count": self.count,
            "sh_count": self.sh_count,
            "prune_rate": self.prune_rate,
            "sh_rate": self.sh_rate,
            "method": self.method,
            "score": self.score,
            "select": self.select,
            "bits": self.bits,
            "groups": self.groups,
            "steps": self.steps,
            "target": self.target,
            "decided_by": self.decided_by,
            "reached": self.reached,
            "decision_views": self.decision_views,
            "search": [step_json(step) for step in self.search.steps] if self.search else [],
            "sensitivity": [{**asdict(item), "loss": item.loss} for item in self.sensitivity],
            "quality": quality_json(self.quality) if self.quality else None,
            "quality_views": self.quality_views,
            "training_fidelity": rounded(self.training_fidelity),
            "scored": asdict(self.scored) if self.scored else None,
            "warnings": list(self.warnings),
            "scores_saved": self.scores_saved,
            "score_cache": self.score_cache,
            "scores_reused": self.scores_reused,
            "run": self.run.to_json(),
        }


@dataclass(frozen=True)
class EvaluateResult:
    """What `evaluate` found: a scene against a reference, over `quality_views`."""

    scene: SceneInfo
    reference: SceneInfo
    views: ViewsInfo
    quality: Quality
    quality_views: str
    run: RunInfo

    def to_json(self) -> dict[str, Any]:
        """The record for machines."""
        return {
            "program": f"flexgs-edge {__version__}",
            "command": "evaluate",
            "input": self.scene.to_json(),
            "reference": self.reference.to_json(),
            "views": self.views.to_json(),
            "quality": quality_json(self.quality),
            "quality_views": self.quality_views,
            "run": self.run.to_json(),
        }


@dataclass(frozen=True)
class RenderResult:
    """What `render` drew; start-up and kernel compilation are in `run`, apart from the views."""

    scene: SceneInfo
    views: ViewsInfo
    files: tuple[str, ...]
    view_seconds: tuple[float, ...]
    warm_up_seconds: float
    run: RunInfo

    @property
    def ms_per_view(self) -> float:
        """Median time of a view in milliseconds, drawing only: no loading, compiling or file writing."""
        times = sorted(self.view_seconds)
        return 1000 * (times[(len(times) - 1) // 2] + times[len(times) // 2]) / 2 if times else 0.0

    def to_json(self) -> dict[str, Any]:
        """The record for machines."""
        run = self.run.to_json()
        return {
            "program": f"flexgs-edge {__version__}",
            "command": "render",
            "input": self.scene.to_json(),
            "views": self.views.to_json(),
            "files": list(self.files),
            "ms_per_view": round(self.ms_per_view, 3),
            "view_ms": [round(1000 * seconds, 3) for seconds in self.view_seconds],
            "startup_ms": run["startup_ms"],
            "compile_ms": run["compile_ms"],
            "warm_up_ms": round(1000 * self.warm_up_seconds, 1),
            "run": run,
        }


@dataclass(frozen=True)
class ScoreResult:
    """What `score` wrote."""

    scene: SceneInfo
    views: ViewsInfo
    output: str
    score: str
    scored_views: int
    unseen: int
    run: RunInfo

    def to_json(self) -> dict[str, Any]:
        """The record for machines."""
        return {
            "program": f"flexgs-edge {__version__}",
            "command": "score",
            "input": self.scene.to_json(),
            "views": self.views.to_json(),
            "output": self.output,
            "score": self.score,
            "scored_views": self.scored_views,
            "unseen": self.unseen,
            "run": self.run.to_json(),
        }


@dataclass(frozen=True)
class DecompressResult:
    """What `decompress` wrote."""

    scene: SceneInfo
    output: str
    size: int
    run: RunInfo
    notes: tuple[str, ...] = field(default=())

    def to_json(self) -> dict[str, Any]:
        """The record for machines."""
        return {
            "program": f"flexgs-edge {__version__}",
            "command": "decompress",
            "input": self.scene.to_json(),
            "output": self.output,
            "size": self.size,
            "notes": list(self.notes),
            "run": self.run.to_json(),
        }
