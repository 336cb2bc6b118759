"""The text that people read, made from the result records and nothing else."""

from __future__ import annotations

from collections.abc import Sequence

from flexgs_edge.quality.view_quality import Quality, ViewQuality
from flexgs_edge.report.results import CompressResult, DecompressResult, EvaluateResult, RenderResult, ScoreResult
from flexgs_edge.report.run_info import RunInfo, SceneInfo, ViewsInfo
from flexgs_edge.units import format_mib, format_size


def compress_text(result: CompressResult) -> str:
    """Summary of a `compress`."""
    lines = [*_scene_lines("scene", result.scene), *_view_lines(result.views)]
    size = f"{result.size} bytes ({format_size(result.size)})"
    if result.output is None:
        lines.append(_line("would write", f"{size}; nothing was written (--dry-run)"))
    else:
        lines.append(_line("wrote", f"{result.output}, {size}"))
    lines.append(
        _line(
            "ratio",
            f"{result.ratio:.2f}x of the PLY's {format_size(result.scene.ply_bytes)} ({_saved(result):.1f} % smaller)",
        )
    )
    share = f"{result.count} of {result.scene.count} Gaussians, {result.sh_count} of them with SH"
    lines.append(_line("kept", f"{share} (prune rate {result.prune_rate:g}, SH rate {result.sh_rate:g})"))
    if result.format != "fgs":
        lines.append(
            _line("format", f".{result.format}, SH degree {result.file_sh_degree}, rounded as that format does")
        )
    elif result.steps is not None:
        steps = (f"{name} {value:.3g}" for name, value in result.steps.items() if not isinstance(value, list))
        lines.append(_line("grid steps", ", ".join(steps)))
    else:
        bits = " ".join(f"{name}={bits}" for name, bits in result.bits.items())
        lines.append(_line("bits", bits + (" (found by sensitivity)" if result.sensitivity else "")))
    lines += _decision_lines(result)
    if result.quality is not None:
        decoded = "decoded file" if result.output else "as it would decode"
        lines += _quality_lines(result.quality, f"{decoded}, {len(result.quality.views)} {result.quality_views} views")
    lines += [_line("warning", words) for words in result.warnings]
    if result.scores_saved:
        lines.append(_line("scores", f"saved to {result.scores_saved}"))
    if result.score_cache:
        lines.append(
            _line("scores", f"{'reused from' if result.scores_reused else 'made anew, kept in'} {result.score_cache}")
        )
    return _text([*lines, *_run_lines(result.run)])


def _saved(result: CompressResult) -> float:
    return 100.0 * (1.0 - 1.0 / result.ratio)


def _decision_lines(result: CompressResult) -> list[str]:
    if result.target is None:
        return [_line("target", "none: fixed rates, no search")]
    steps = result.search.steps if result.search else ()
    verdict = "reached" if result.reached else "NOT reached: this is the closest point (--best-effort)"
    lines = [_line("target", f"{result.target}: {verdict}, after {len(steps)} steps")]
    lines.append(_line("decided by", decided_words(result)))
    return lines


def decided_words(result: CompressResult) -> str:
    """Which figure decided, and on which views."""
    by = {
        "drop": "the drop against the photos",
        "modelled drop": "the modelled drop (no photos decide: error against the original's renders)",
        "fidelity": "the fidelity (PSNR against the original's renders)",
        "size": "the size; among points that fit, quality",
    }[result.decided_by or "size"]
    where = {
        "held-out": "on the held-out views, which decide only where to stop",
        "training": "on the training poses",
        "none": "without views",
    }[result.decision_views]
    return f"{by}, {where}"


def evaluate_text(result: EvaluateResult) -> str:
    """Summary of an `evaluate`, with a row a view."""
    lines = [
        *_scene_lines("scene", result.scene),
        *_scene_lines("against", result.reference),
        *_view_lines(result.views),
    ]
    lines += _quality_lines(result.quality, f"{len(result.quality.views)} {result.quality_views} views")
    lines += ["", *_view_table(result.quality.views)]
    return _text([*lines, "", *_run_lines(result.run)])


def _view_table(views: Sequence[ViewQuality]) -> list[str]:
    rows: list[tuple[str, ...]] = [
        ("view", "fidelity", "SSIM to ref.", "drop", "PSNR", "of original", "SSIM", "of original")
    ]
    with_lpips = any(view.lpips_original is not None for view in views)
    if with_lpips:
        rows[0] += ("LPIPS to ref.", "LPIPS", "of original")
    for view in views:
        photo = view.photo_error is not None
        rows.append(
            (
                view.name,
                _decibel(view.fidelity),
                _similar(view.ssim_original),
                _decibel(view.drop) if photo else "-",
                _decibel(view.psnr) if photo else "-",
                _decibel(view.original_psnr) if photo else "-",
                _similar(view.ssim_photo),
                _similar(view.original_ssim),
            )
        )
        if with_lpips:
            rows[-1] += tuple(map(_similar, (view.lpips_original, view.lpips_photo, view.original_lpips)))
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return [
        "  ".join(
            [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))]
        )
        for row in rows
    ]


def render_text(result: RenderResult) -> str:
    """Summary of a `render`."""
    lines = [*_scene_lines("scene", result.scene), *_view_lines(result.views)]
    first = result.files[0] if result.files else "no files"
    last = f" ... {result.files[-1]}" if len(result.files) > 1 else ""
    lines.append(_line("wrote", f"{len(result.files)} PNG files: {first}{last}"))
    lines.append(
        _line(
            "time",
            f"{result.ms_per_view:.1f} ms a view (median); start-up {1000 * result.run.startup_seconds:.0f} ms and "
            f"kernel compilation {1000 * result.run.compile_seconds:.0f} ms apart",
        )
    )
    return _text([*lines, *_run_lines(result.run)])


def score_text(result: ScoreResult) -> str:
    """Summary of a `score`."""
    lines = [*_scene_lines("scene", result.scene), *_view_lines(result.views)]
    unseen = f"; {result.unseen} Gaussians are in none of them" if result.unseen else ""
    lines.append(_line("scored", f"{result.score}, over {result.scored_views} training poses{unseen}"))
    lines.append(_line("wrote", result.output))
    return _text([*lines, *_run_lines(result.run)])


def decompress_text(result: DecompressResult) -> str:
    """Summary of a `decompress`."""
    lines = _scene_lines("scene", result.scene)
    lines.append(_line("wrote", f"{result.output}, {result.size} bytes ({format_size(result.size)})"))
    lines += [_line("note", note) for note in result.notes]
    return _text([*lines, *_run_lines(result.run)])


def _scene_lines(label: str, scene: SceneInfo) -> list[str]:
    lines = [_line(label, f"{scene.path}: {scene.count} Gaussians, SH degree {scene.sh_degree}")]
    return lines + [_line("note", note) for note in scene.notes]


def _view_lines(views: ViewsInfo | None) -> list[str]:
    if views is None:
        return [_line("views", "none")]
    split = f"{views.total} views of {views.width}x{views.height} ({views.train} training, {views.held_out} held out)"
    photos = f"photos from {views.images}" if views.images else "no photos"
    lines = [_line("views", f"{split}; cameras from {views.cameras}, {photos}")]
    return lines + [_line("note", note) for note in views.notes]


def _quality_lines(quality: Quality, where: str) -> list[str]:
    lines = []
    if quality.drop is not None:
        similar = (
            ""
            if quality.ssim_photo is None
            else f", SSIM {_similar(quality.original_ssim)} -> {_similar(quality.ssim_photo)}"
        )
        if quality.lpips_photo is not None:
            similar += f", LPIPS {_similar(quality.original_lpips)} -> {_similar(quality.lpips_photo)}"
        lines.append(
            _line(
                "drop",
                f"{_decibel(quality.drop)} dB against the photos: PSNR {_decibel(quality.original_psnr)} -> "
                f"{_decibel(quality.psnr)} dB{similar} (mean, {where})",
            )
        )
    identical = f", {quality.identical} views identical" if quality.identical and quality.fidelity is not None else ""
    unit = "" if quality.fidelity is None else " dB"
    similar = "" if quality.ssim_original is None else f", SSIM {_similar(quality.ssim_original)}"
    if quality.lpips_original is not None:
        similar += f", LPIPS {_similar(quality.lpips_original)}"
    lines.append(
        _line(
            "fidelity",
            f"{_decibel(quality.fidelity)}{unit} against the original's renders{identical}{similar}; modelled drop "
            f"{quality.modelled_drop:.3f} dB from a base of {quality.base_psnr:g} dB (mean, {where})",
        )
    )
    worst = quality.worst
    if worst is not None:
        drop = "" if worst.drop is None else f"drop {_decibel(worst.drop)} dB, "
        lines.append(_line("worst view", f"{worst.name}: {drop}fidelity {_decibel(worst.fidelity)}{unit}"))
    return lines


def _run_lines(run: RunInfo) -> list[str]:
    stages = ", ".join(f"{name} {seconds:.1f}" for name, seconds in run.stages.items())
    lines = [_line("took", f"{run.seconds:.1f} s ({stages})")]
    lines.append(_line("memory", memory_words(run)))
    if run.device is not None:
        lines.append(_line("device", device_words(run.device)))
    return lines


def memory_words(run: RunInfo) -> str:
    """Peak and limit; with scratch files what they took, and the peak of what cannot go there."""
    words = f"peak {format_mib(run.peak_memory)} of a limit of {format_mib(run.memory_limit)}"
    if run.scratch is None:
        return words
    pages = f" (pages of {format_mib(run.scratch)} in scratch files among them)"
    anonymous = "" if run.peak_anonymous is None else f", {format_mib(run.peak_anonymous)} without a file behind them"
    return f"{words}{pages}{anonymous}"


def device_words(device: dict[str, object]) -> str:
    """What ran the kernels, in a line."""
    if device.get("backend") == "numpy":
        return "NumPy twins (--device numpy): same results as OpenCL, far slower"
    return f"{device.get('name')} ({device.get('platform')})"


def _decibel(value: float | None) -> str:
    return "identical" if value is None else f"{value:.3f}"


def _similar(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"


def _line(label: str, text: str) -> str:
    return f"{label + ':':<12} {text}"


def _text(lines: list[str]) -> str:
    return "\n".join(lines) + "\n"
