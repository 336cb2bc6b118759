"""Results of `compress`, of one scene or several, and of `evaluate`: the commands that measure quality.

The JSON keys are the field names below, unless a docstring says otherwise. Sizes are bytes and quality is dB. Times are
seconds, or milliseconds if the name ends in `_ms`. null means "identical" for PSNR and fidelity, and "not measured" for photos
and targets.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from flexgs_edge.goals.promise import KeptPromise
from flexgs_edge.goals.steps import Scored, SearchResult
from flexgs_edge.quality.view_quality import Quality, ViewQuality
from flexgs_edge.report.as_json import promise_json, quality_json, rounded, step_json
from flexgs_edge.report.run_info import RemovedGroup, Result, RunInfo, SceneInfo, ViewsInfo, record
from flexgs_edge.report.summary import (
    aligned,
    decibel,
    line,
    quality_lines,
    ratio_lines,
    run_lines,
    scene_lines,
    similar,
    text,
    view_lines,
)
from flexgs_edge.units import format_size

_FAULT, _FAILED = 1, 2
_HEADINGS = ("input", "output", "as .ply", "file", "ratio", "quality", "time")


@dataclass(frozen=True)
class CompressResult(Result):
    """Result of `compress`.

    `scene`, `views`: the input scene, and the views; `views` is `None` for a run without cameras. `count`, `sh_count`:
    Gaussians kept, and those of them with SH above degree 0. `prune_rate`, `sh_rate`: shares of all Gaussians: those
    removed, and those kept without their SH. `method`, `score`, `select`: options of the run.
    """

    scene: SceneInfo
    views: ViewsInfo | None
    output: str | None  # the file written; `None` in a dry run
    size: int  # Bytes of the file. A dry run gives the exact size that the file would have.
    count: int
    sh_count: int
    prune_rate: float
    sh_rate: float
    method: str
    score: str | None
    select: str
    bits: dict[str, int]  # bits per attribute (`paper`)
    groups: dict[str, int]  # quantization groups per channel, by attribute (`paper`)
    steps: dict[str, Any] | None  # step sizes by attribute (`best`)
    target: str | None  # the target in words; `None` for fixed rates
    decided_by: str | None  # `drop`, `modelled drop`, `fidelity` or `size`; `None` for fixed rates
    reached: bool | None  # whether the deciding views meet the target; `None` for fixed rates
    decision_views: str  # the kind of views that decided: `held-out`, `training` or `none`
    search: SearchResult | None  # every step of the search; `None` for fixed rates
    quality: Quality | None  # quality of the decoded file over `quality_views`; `None` without cameras
    quality_views: str  # the kind of views that `quality` is measured on: `held-out`, `training` or `none`
    score_cache: str | None  # file that keeps the scores between runs
    scores_reused: bool  # whether the scores came from that file
    run: RunInfo  # times, memory and device
    format: str = "fgs"  # `fgs`, `spz`, `sog` or `compressed.ply`
    file_sh_degree: int | None = None  # SH degree of the file
    scored: Scored | None = None  # scored views and unseen Gaussians of a search by measured costs (`best`)
    # Fidelity of the decoded file on some training views, dB. Measured only if `quality` comes from held-out views.
    training_fidelity: float | None = None
    warnings: tuple[str, ...] = ()  # Reasons to trust the figures less. Each names a number and what to do.
    # How the bounds beside the target stand on the deciding views; `None` without such bounds.
    promise: KeptPromise | None = None
    removed: tuple[RemovedGroup, ...] = ()  # the kinds of Gaussians that `--clean` found
    preview_bytes: int = 0  # bytes of the file that are its preview (`best`); 0 if it has none

    @property
    def ratio(self) -> float:
        """Bytes of the scene as a PLY in INRIA's layout, divided by those of the file."""
        return self.scene.ply_bytes / self.size

    @property
    def ratio_of_input(self) -> float | None:
        """Bytes of the input file divided by those of the file; `None` for a scene from memory."""
        return self.scene.ratio_of(self.size)

    @property
    def ratio_without_normals(self) -> float:
        """Bytes of the scene as a PLY without normals, divided by those of the file."""
        return self.scene.ply_bytes_without_normals / self.size

    def to_json(self) -> dict[str, Any]:
        return record(
            "compress",
            self,
            ratio=round(self.ratio, 4),
            ratio_without_normals=round(self.ratio_without_normals, 4),
            ratio_of_input=rounded(self.ratio_of_input),
            promise=promise_json(self.promise),
            search=[step_json(step) for step in self.search.steps] if self.search else [],
            quality=quality_json(self.quality) if self.quality else None,
            training_fidelity=rounded(self.training_fidelity),
        )

    def summary(self) -> str:
        lines = [*scene_lines("scene", self.scene), *view_lines(self.views)]
        size = f"{self.size} bytes ({format_size(self.size)})"
        if self.output is None:
            lines.append(line("would write", f"{size}; nothing was written (--dry-run)"))
        else:
            lines.append(line("wrote", f"{self.output}, {size}"))
        if self.preview_bytes:
            share = f"{100 * self.preview_bytes / self.size:.2g} % of it"
            lines.append(line("preview", f"{format_size(self.preview_bytes)}, {share}"))
        lines += ratio_lines(self.scene, self.size)
        share = f"{self.count} of {self.scene.count} Gaussians, {self.sh_count} of them with SH"
        lines.append(line("kept", f"{share} (prune rate {self.prune_rate:g}, SH rate {self.sh_rate:g})"))
        if self.format != "fgs":
            degree = f"SH degree {self.file_sh_degree}"
            lines.append(line("format", f".{self.format}, {degree}, rounded as that format does"))
        elif self.steps is not None:
            steps = (f"{name} {value:.3g}" for name, value in self.steps.items() if isinstance(value, float))
            lines.append(line("grid steps", ", ".join(steps)))
        else:
            bits = " ".join(f"{name}={bits}" for name, bits in self.bits.items())
            lines.append(line("bits", bits))
        lines += _decision_lines(self)
        if self.quality is not None:
            decoded = "decoded file" if self.output else "as it would decode"
            lines += quality_lines(self.quality, f"{decoded}, {len(self.quality.views)} {self.quality_views} views")
        lines += [line("warning", words) for words in self.warnings]
        if self.score_cache:
            made = "reused from" if self.scores_reused else "made anew, kept in"
            lines.append(line("scores", f"{made} {self.score_cache}"))
        return text([*lines, *run_lines(self.run)])


def _decision_lines(result: CompressResult) -> list[str]:
    if result.target is None:
        return [line("target", "none: fixed rates, no search")]
    steps = result.search.steps if result.search else ()
    verdict = "reached" if result.reached else "NOT reached: this is the closest point"
    lines = [line("target", f"{result.target}: {verdict}, after {len(steps)} steps")]
    lines.append(line("decided by", decided_words(result)))
    if result.promise is not None:
        words = [part.words if part.held else f"{part.words}: NOT kept" for part in result.promise.parts]
        decided = "" if result.promise.decided == "target" else f" (the {result.promise.decided} decided)"
        lines.append(line("promise", f"{'; '.join(words)}{decided}"))
    return lines


def decided_words(result: CompressResult) -> str:
    """Describe the figure that decided, and the views it was measured on."""
    by = {
        "drop": "the drop against the photos",
        "modelled drop": "the modelled drop (no photos decide: error against the original's renders)",
        "fidelity": "the fidelity (PSNR against the original's renders)",
        "size": "the size; among points that fit, quality",
    }[result.decided_by or "size"]
    if result.quality is not None and result.quality.covered_decides:
        by += " over what the original covers"
    where = {
        "held-out": "on the held-out views, which decide only where to stop",
        "training": "on the training poses",
        "none": "without views",
    }[result.decision_views]
    return f"{by}, {where}"


@dataclass(frozen=True)
class EvaluateResult(Result):
    """Result of `evaluate`: the quality of a scene against its original, over `quality_views`."""

    scene: SceneInfo
    reference: SceneInfo
    views: ViewsInfo
    quality: Quality
    quality_views: str
    run: RunInfo
    warnings: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        return record("evaluate", self, quality=quality_json(self.quality))

    def summary(self) -> str:
        lines = [*scene_lines("scene", self.scene), *scene_lines("against", self.reference), *view_lines(self.views)]
        lines += quality_lines(self.quality, f"{len(self.quality.views)} {self.quality_views} views")
        lines += [line("warning", words) for words in self.warnings]
        lines += ["", *_view_table(self.quality.views)]
        return text([*lines, "", *run_lines(self.run)])


def _view_table(views: Sequence[ViewQuality]) -> list[str]:
    def figure(head: str, name: str) -> tuple[str, Callable[[ViewQuality], str]]:
        return head, lambda view: similar(getattr(view, name))

    def against_photo(head: str, name: str) -> tuple[str, Callable[[ViewQuality], str]]:
        return head, lambda view: "-" if view.photo_error is None else decibel(getattr(view, name))

    columns: list[tuple[str, Callable[[ViewQuality], str]]] = [
        ("view", lambda view: view.name),
        ("fidelity", lambda view: decibel(view.fidelity)),
        ("covered", lambda view: decibel(view.covered_fidelity) if view.coverage else "-"),
        ("coverage", lambda view: f"{100 * view.coverage:.3g} %"),
        figure("SSIM to ref.", "ssim_original"),
        figure("FLIP to ref.", "flip_original"),
        against_photo("drop", "drop"),
        against_photo("PSNR", "psnr"),
        against_photo("of original", "original_psnr"),
        figure("SSIM", "ssim_photo"),
        figure("of original", "original_ssim"),
        figure("FLIP", "flip_photo"),
        figure("of original", "original_flip"),
    ]
    if any(view.lpips_original is not None for view in views):
        columns += [figure("LPIPS to ref.", "lpips_original"), figure("LPIPS", "lpips_photo")]
        columns.append(figure("of original", "original_lpips"))
    return aligned([[head for head, _ in columns], *([cell(view) for _, cell in columns] for view in views)])


@dataclass(frozen=True)
class BatchItem:
    """One scene of several."""

    input: str  # the scene, as given or as found in a folder
    result: CompressResult | None  # `None` if the scene failed
    error: str | None = None  # why it failed
    exit_code: int = 0  # what `compress` of this scene alone would have ended with

    @property
    def reason(self) -> str:
        """The error without the name of the scene in front."""
        return (self.error or "").removeprefix(f"{self.input}: ")

    def to_json(self) -> dict[str, Any]:
        """Return the record of `compress`, or the error, as JSON values."""
        if self.result is not None:
            return self.result.to_json()
        return {"input": {"path": self.input}, "error": self.error, "exit_code": self.exit_code}


@dataclass(frozen=True)
class BatchResult(Result):
    """Result of `compress_all`."""

    items: tuple[BatchItem, ...]  # the scenes that are done or failed, in the order of the inputs
    total: int  # Number of scenes. An interruption leaves more of them than `items`.
    seconds: float  # wall seconds of all

    @property
    def results(self) -> tuple[CompressResult, ...]:
        """The results of the scenes that are done."""
        return tuple(item.result for item in self.items if item.result is not None)

    @property
    def failed(self) -> tuple[BatchItem, ...]:
        """The scenes that failed."""
        return tuple(item for item in self.items if item.result is None)

    @property
    def exit_code(self) -> int:
        """0 if all are done, 2 if any failed, 1 if any failed by a fault of ours."""
        codes = {item.exit_code for item in self.failed}
        return _FAULT if _FAULT in codes else _FAILED if codes else 0

    def to_json(self) -> list[dict[str, Any]]:
        """Return the record of each scene as JSON values."""
        return [item.to_json() for item in self.items]

    def summary(self) -> str:
        rows = [_HEADINGS] + [_row(item.result) for item in self.items if item.result is not None]
        widths = [max(len(row[column]) for row in rows) for column in range(len(_HEADINGS))]
        widths[0] = max([widths[0], *(len(item.input) for item in self.items)])
        lines = [_aligned(_HEADINGS, widths)] if self.results else []
        for item in self.items:
            if item.result is None:
                lines.append(f"{item.input.ljust(widths[0])}  FAILED: {item.reason}")
            else:
                lines.append(_aligned(_row(item.result), widths))
        return text([*lines, self._sums()])

    def _sums(self) -> str:
        results, left = self.results, self.total - len(self.items)
        words = f"{len(results)} of {self.total} scenes done"
        words += f", {len(self.failed)} failed" if self.failed else ""
        words += f", {left} not begun or not finished" if left else ""
        if results:
            before, after = sum(each.scene.ply_bytes for each in results), sum(each.size for each in results)
            words += f": {format_size(before)} -> {format_size(after)} ({before / after:.2f}x)"
        words += f", {self.seconds:.1f} s"
        dry = bool(results) and all(each.output is None for each in results)
        return words + ("; nothing was written (--dry-run)" if dry else "")


def _row(result: CompressResult) -> tuple[str, ...]:
    return (
        result.scene.path,
        result.output or "-",
        format_size(result.scene.ply_bytes),
        format_size(result.size),
        f"{result.ratio:.2f}x",
        _quality(result),
        f"{result.run.seconds:.1f} s",
    )


def _quality(result: CompressResult) -> str:
    """The figure that decided, else the drop."""
    quality = result.quality
    if quality is None:
        return "-"
    missed = "" if result.reached in (True, None) else ", NOT reached"
    if result.decided_by == "fidelity":
        return f"fidelity {decibel(quality.fidelity)}{'' if quality.fidelity is None else ' dB'}{missed}"
    if quality.drop is not None and result.decided_by != "modelled drop":
        return f"drop {decibel(quality.usual_drop)} dB{missed}"
    return f"modelled drop {quality.modelled_drop:.3f} dB{missed}"


def _aligned(row: tuple[str, ...], widths: list[int]) -> str:
    """Names to the left, numbers to the right."""
    cells = [
        cell.rjust(width) if 2 <= column <= 4 or column == 6 else cell.ljust(width)
        for column, (cell, width) in enumerate(zip(row, widths, strict=True))
    ]
    return "  ".join(cells).rstrip()
