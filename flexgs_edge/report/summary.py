"""Lines of the printed summary that several results share."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from flexgs_edge.report.run_info import SIMILARITIES, RunInfo, SceneInfo, ViewsInfo
from flexgs_edge.units import format_mib, format_size, smaller_words

if TYPE_CHECKING:  # so that `trim` and `verify` start without kernels
    from flexgs_edge.quality.view_quality import Quality

FAR_SHOWN = 4  # Names of views that one line shows


def scene_lines(label: str, scene: SceneInfo) -> list[str]:
    """Describe an input scene and its notes."""
    lines = [line(label, f"{scene.path}: {scene.count} Gaussians, SH degree {scene.sh_degree}")]
    return lines + [line("note", note) for note in scene.notes]


def ratio_lines(scene: SceneInfo, size: int) -> list[str]:
    """Compare `size` bytes with the input, and with INRIA's PLY where that is another number."""
    lines = []
    if scene.bytes is not None and not scene.plain:
        ratio = f"{scene.bytes / size:.2f}x of the input's {format_size(scene.bytes)}"
        lines.append(line("ratio", f"{ratio} ({smaller_words(size, scene.bytes)})"))
    ratio = f"{scene.ply_bytes / size:.2f}x of the PLY's {format_size(scene.ply_bytes)}"
    return [*lines, line("of a PLY" if lines else "ratio", f"{ratio} ({smaller_words(size, scene.ply_bytes)})")]


def view_lines(views: ViewsInfo | None) -> list[str]:
    """Describe the views, where they came from, and their notes."""
    if views is None:
        return [line("views", "none")]
    split = f"{views.total} views of {views.width}x{views.height} ({views.train} training, {views.held_out} held out)"
    photos = f"photos from {views.images}" if views.images else "no photos"
    lines = [line("views", f"{split}; cameras from {views.cameras}, {photos}")]
    return lines + [line("note", note) for note in views.notes]


def quality_lines(quality: "Quality", where: str) -> list[str]:
    """Describe drop, fidelity and the worst view; `where` names the views that were measured."""
    lines = []
    if quality.drop is not None:
        also = "".join(
            f", {name.upper()} {similar(getattr(quality, f'original_{name}'))} -> {similar(found)}"
            for name in SIMILARITIES
            if (found := getattr(quality, f"{name}_photo")) is not None
        )
        psnr = f"PSNR {decibel(quality.original_psnr)} -> {decibel(quality.psnr)} dB"
        lines.append(line("drop", f"{decibel(quality.drop)} dB against the photos: {psnr}{also} (mean, {where})"))
        lines += _photo_lines(quality)
    identical = f", {quality.identical} views identical" if quality.identical and quality.fidelity is not None else ""
    unit = "" if quality.fidelity is None else " dB"
    also = "".join(
        f", {name.upper()} {similar(found)}"
        for name in SIMILARITIES
        if (found := getattr(quality, f"{name}_original")) is not None
    )
    modelled = (
        f"{quality.modelled_drop:.3f} dB if the photos are {quality.base_psnr:g} dB from the original (mean, {where})"
    )
    against = f"{decibel(quality.fidelity)}{unit} against the original's renders{identical}{also}"
    lines.append(line("fidelity", f"{against}; modelled drop {modelled}"))
    fidelity = decibel(quality.covered_fidelity) + ("" if quality.covered_fidelity is None else " dB")
    where = f"over the part of the pictures that the original covers ({100 * quality.coverage:.3g} %)"
    lines.append(line("covered", f"fidelity {fidelity}, modelled drop {quality.covered_modelled_drop:.3f} dB {where}"))
    worst = quality.worst
    if worst is not None:
        kind = "drop" if worst.far_base is None else "modelled drop"
        drop = "" if worst.loss is None else f"{kind} {worst.loss:.3f} dB, "
        covered = f", {decibel(worst.covered_fidelity)}{unit} covered" if quality.covered_decides else ""
        lines.append(line("worst view", f"{worst.name}: {drop}fidelity {decibel(worst.fidelity)}{unit}{covered}"))
    seen = quality.worst_flip
    if seen is not None:
        lines.append(line("worst FLIP", f"{similar(seen.flip_original)} against the original's render, {seen.name}"))
    return lines


def _photo_lines(quality: "Quality") -> list[str]:
    """What was done to photos of another exposure, and which views do not count by their photo."""
    lines, total = [], len(quality.views)
    stops = [stop for view in quality.views for stop in view.exposure or ()]
    if stops:
        done = f"{len(stops) // 3} of {total} photos were brought to the exposure of the original"
        by = f"({min(stops):+.2f} to {max(stops):+.2f} stops)"
        lines.append(line("exposure", f"{done} {by}; --exposure none compares them as they are"))
    far = [view for view in quality.views if view.far_base is not None]
    counted = quality.usual_drop or 0.0
    if far:
        shown = ", ".join(view.name for view in far[:FAR_SHOWN]) + (", ..." if len(far) > FAR_SHOWN else "")
        where = (
            f"The original is far from its photo in {len(far)} of {total} views ({shown}), where a photo shows no loss"
        )
        base = f"their modelled drop from {far[0].far_base:.1f} dB"
        lines.append(line("counted", f"{counted:.3f} dB. {where}, so these count by {base}"))
    elif quality.drop is not None and counted - quality.drop >= 0.001:
        lines.append(line("counted", f"{counted:.3f} dB: a view that gains counts as 0"))
    return lines


def run_lines(run: RunInfo) -> list[str]:
    """Describe seconds by stage, memory and device."""
    stages = ", ".join(f"{name} {seconds:.1f}" for name, seconds in run.stages.items())
    lines = [line("took", f"{run.seconds:.1f} s ({stages})")]
    lines.append(line("memory", memory_words(run)))
    if run.device is not None:
        lines.append(line("device", device_words(run.device)))
    return lines


def memory_words(run: RunInfo) -> str:
    """Describe peak memory and its limit. With scratch files, also their bytes and the peak of memory that no file backs."""
    words = f"peak {format_mib(run.peak_memory)} of a limit of {format_mib(run.memory_limit)}"
    if run.scratch is None:
        return words
    pages = f" (pages of {format_mib(run.scratch)} in scratch files among them)"
    anonymous = "" if run.peak_anonymous is None else f", {format_mib(run.peak_anonymous)} without a file behind them"
    return f"{words}{pages}{anonymous}"


def device_words(device: dict[str, object]) -> str:
    """Describe the device that ran the kernels, in one line."""
    if device.get("backend") == "numpy":
        return "NumPy twins (--device numpy): same results as OpenCL, far slower"
    return f"{device.get('name')} ({device.get('platform')})"


def decibel(value: float | None) -> str:
    """Format a figure in dB; `None` means identical pictures."""
    return "identical" if value is None else f"{value:.3f}"


def similar(value: float | None) -> str:
    """Format an SSIM, FLIP or LPIPS; `None` means not measured."""
    return "-" if value is None else f"{value:.4f}"


def line(label: str, words: str) -> str:
    """Format a line of the summary, with its label in the first column."""
    return f"{label + ':':<12} {words}"


def text(lines: list[str]) -> str:
    """Join lines to a text."""
    return "\n".join(lines) + "\n"


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table: names to the left, all other cells to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join([row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True))])
        for row in rows
    ]
