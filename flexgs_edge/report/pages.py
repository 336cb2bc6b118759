"""Make the HTML page of a `compress` or an `evaluate` from its result, pictures and live scenes."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any

import numpy as np

from flexgs_edge.constants import FLIP_DEGREE
from flexgs_edge.goals.steps import Step
from flexgs_edge.goals.target import Target
from flexgs_edge.quality.view_quality import Quality
from flexgs_edge.report.html import count, figure, render
from flexgs_edge.report.results import CompressResult, EvaluateResult, decided_words
from flexgs_edge.report.run_info import RunInfo, SceneInfo
from flexgs_edge.report.summary import device_words, memory_words
from flexgs_edge.units import format_size, times_words, unit_of

# As wide as a phone, so that text stays readable there. On larger screens the chart and its text grow together.
WIDTH, HEIGHT = 360, 230
_LEFT, _RIGHT, _TOP, _BOTTOM = 44, WIDTH - 12, 14, HEIGHT - 38
FEW_ROWS = 16  # With more steps than this, their table is folded up. With more views, their table scrolls.
ERROR_SCALE = 0.1
"""Differences from this share of the full range up get the brightest colour. All maps use the same scale, so that two pages can
be compared. At a fidelity of 40 dB a typical difference is a tenth of it, and half of it at edges."""
FLIP_SCALE = 0.5
"""FLIP from this value up gets the brightest colour. At a drop of 1 dB a typical pixel has a tenth to a fifth of it, and one in a
hundred 0.15 to 0.3."""
# Brightness rises evenly, so that the map can also be read in grey.
_STOPS = ((8, 6, 20), (74, 24, 110), (176, 50, 92), (240, 120, 40), (255, 206, 90), (255, 252, 232))


@dataclass(frozen=True)
class Shot:
    """Pictures of one view, JPEG.

    `rank`, `of`: rank among the measured views, 0 for the worst, and the number of measured views. `width`, `height`:
    pixels of the pictures. Wider views were scaled down. `original`, `compressed`, `error`: render of the original,
    render of the decoded file, and the error map between them.
    """

    view: int  # index into the views of the record's quality
    camera: int  # index into all cameras of the run
    rank: int
    of: int
    width: int
    height: int
    original: bytes
    compressed: bytes
    error: bytes
    flip: bytes  # map of FLIP between both renders
    photo: bytes | None = None  # the photo of this view, if there is one

    @property
    def place(self) -> str:
        """Describe the rank in words.

        >>> Shot(0, 0, 0, 5, 1, 1, b"", b"", b"", b"").place, Shot(0, 0, 1, 5, 1, 1, b"", b"", b"", b"").place
        ('Worst view', 'View 2 of 5 from the worst')
        """
        if self.of == 1:
            return "The only view"
        special = {self.of - 1: "Best view", (self.of - 1) // 2: "Median view", 0: "Worst view"}
        return special.get(self.rank, f"View {self.rank + 1} of {self.of} from the worst")


@dataclass(frozen=True)
class Live:
    """Scenes that a page draws while it is looked at."""

    script: str  # draws them
    config: dict[str, Any]  # cameras, the first of them, and how the scenes are drawn
    compressed: bytes | None  # the `.fgs` that was made; `None` if it is too large
    original: bytes | None  # the original as a `.fgs`
    note: str  # why a scene is not there


@dataclass(frozen=True)
class Cleaned:
    """Pictures of the view that shows most of what a cleaning removed, JPEG."""

    view: str  # name of the camera
    width: int
    height: int
    before: bytes
    after: bytes
    removed: bytes  # what went, alone


@dataclass(frozen=True)
class Material:
    """Contents of a page besides the result."""

    shots: tuple[Shot, ...] = ()  # pictures, worst view first
    contents: dict[str, Any] | None = None  # JSON record of `info`; `None` for formats whose channels it does not know
    target: Target | None = None  # target that the search chart marks with a line
    live: Live | None = None  # live scenes
    cleaned: Cleaned | None = None  # what `--clean` did


def ramp() -> np.ndarray:
    """Colours of 256 even steps from no error to the largest, [256, 3] u8."""
    at = np.linspace(0, len(_STOPS) - 1, 256)
    stops = np.array(_STOPS, np.float64).T
    return np.stack([np.rint(np.interp(at, range(len(_STOPS)), channel)) for channel in stops], axis=1).astype(np.uint8)


def error_map(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Largest difference over the channels of two [H, W, 3] images, divided by `ERROR_SCALE`: [H, W] f32 from 0 to 1."""
    difference = np.abs(np.clip(image, 0.0, 1.0) - np.clip(reference, 0.0, 1.0)).max(axis=2)
    return np.minimum(difference / np.float32(ERROR_SCALE), np.float32(1.0))


def step_chart(steps: Sequence[Step], chosen: Step, target: Target) -> str:
    """Draw file size against the deciding figure, with one mark per step.

    Returns an empty string if fewer than two steps can be shown. Steps with identical renders have no place on a scale in dB.
    """
    judge = target.figure
    # Find the chosen step by identity: other steps may have equal figures.
    points = [(s.size, at, s) for s in steps if s.measurement and (at := s.measurement.figure(judge)) is not None]
    if len(points) < 2:
        return ""
    limit = getattr(target, "limit", None) if target.limit_bytes is None else None
    low_x, high_x, ticks_x = nice_range([p[0] for p in points] + ([target.limit_bytes] if target.limit_bytes else []))
    low_y, high_y, ticks_y = nice_range([p[1] for p in points] + ([limit] if limit is not None else []))
    word, unit = unit_of(high_x)

    def x(value: float) -> float:
        return _LEFT + (value - low_x) / (high_x - low_x) * (_RIGHT - _LEFT)

    def y(value: float) -> float:
        return _BOTTOM - (value - low_y) / (high_y - low_y) * (_BOTTOM - _TOP)

    return render(
        "step_chart.svg",
        width=WIDTH,
        height=HEIGHT,
        left=_LEFT,
        right=_RIGHT,
        top=_TOP,
        bottom=_BOTTOM,
        judge=judge,
        target=target,
        chosen=chosen,
        unit=word,
        ticks_x=[(tick / unit, x(tick)) for tick in ticks_x],
        ticks_y=[(tick, y(tick)) for tick in ticks_y],
        limit_x=None if target.limit_bytes is None else x(target.limit_bytes),
        limit_y=None if limit is None else y(limit),
        marks=[(x(size), y(at), step) for size, at, step in points],
    )


def nice_range(values: Sequence[float], most: int = 5) -> tuple[float, float, list[float]]:
    """Choose the ends of an axis with a margin around all values, and at most `most` + 1 round ticks.

    >>> nice_range([0.0, 1.0])
    (-0.08, 1.08, [0.0, 0.2, 0.4, 0.6, 0.8, 1.0])
    """
    low, high = min(values), max(values)
    span = high - low or abs(high) or 1.0
    low, high = low - 0.08 * span, high + 0.08 * span
    raw = (high - low) / (most + 1)
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= raw * (1 - 1e-9))
    first, last = math.ceil(low / step), math.floor(high / step)
    return low, high, [round(index * step, 12) for index in range(first, last + 1)]


def compress_page(result: CompressResult, material: Material) -> str:
    """Return the page of a `compress`, as HTML."""
    quality, search, target = result.quality, result.search, material.target
    name = _name(result.output or result.scene.path)
    done, became = ("would be", "would become") if result.output is None else ("is", "became")
    given = result.scene.bytes
    if given is None or result.scene.plain:
        given = result.scene.ply_bytes
    kind = " of PLY" if result.scene.plain else ""
    lead = f"{format_size(given)}{kind} {became} {format_size(result.size)}."
    if quality is not None:
        lead += f" {_loss_words(quality, result.quality_views)}"
    tiles = [
        _times_tile(given / result.size),
        (format_size(result.size), f"file, of {format_size(given)}"),
        *_quality_tiles(quality),
        (f"{100 * result.count / max(result.scene.count, 1):.1f} %", f"{count(result.count)} Gaussians kept"),
    ]
    return render(
        "compress.html",
        title=f"{name} {done} {times_words(given / result.size, 1)}",
        lead=lead,
        tiles=tiles,
        left="original",
        right="compressed",
        step_chart=step_chart(search.steps, search.chosen, target) if search and target else "",
        decided_by=decided_words(result),
        facts=_compress_facts(result) + _run_facts(result.run),
        **_shared(result, material),
    )


def evaluate_page(result: EvaluateResult, material: Material) -> str:
    """Return the page of an `evaluate`, as HTML."""
    tiles, contents = _quality_tiles(result.quality), material.contents
    if contents is not None and contents.get("ratio"):
        times, word = _times_tile(contents["ratio"])
        tiles.insert(0, (times, f"{word}: {format_size(contents['size'])}"))
    tiles.append((count(result.scene.count), f"Gaussians, of {count(result.reference.count)}"))
    scenes = _scene_facts("scene", result.scene) + _scene_facts("against", result.reference)
    return render(
        "report.html",
        title=f"{_name(result.scene.path)} against {_name(result.reference.path)}",
        lead=_loss_words(result.quality, result.quality_views),
        tiles=tiles,
        left="reference",
        right="this scene",
        facts=scenes + _run_facts(result.run),
        **_shared(result, material),
    )


def _shared(result: CompressResult | EvaluateResult, material: Material) -> dict[str, Any]:
    """Return the template values that both pages share."""
    numbers = {shot.view: number for number, shot in enumerate(material.shots, start=1)}
    return {
        "result": result,
        "quality": result.quality,
        "photos": result.quality is not None and any(view.photo_error is not None for view in result.quality.views),
        "material": material,
        "numbers": numbers,
        "few": FEW_ROWS,
        "error_scale": ERROR_SCALE,
        "flip_scale": FLIP_SCALE,
        "flip_degree": FLIP_DEGREE,
        "error_ramp": f"linear-gradient(90deg,{','.join(f'rgb({r} {g} {b})' for r, g, b in _STOPS)})",
        "channels": _channel_rows(material.contents or {}),
        "stages": [(name, seconds, [f"{seconds:.2f} s"]) for name, seconds in result.run.stages.items()],
    }


def _name(path: str) -> str:
    return PurePath(path).name or path


def _loss_words(quality: Quality, kind: str) -> str:
    over = f"mean over {len(quality.views)} {kind} view{'s' if len(quality.views) != 1 else ''}"
    if quality.fidelity is None:
        return f"The renders are identical ({over})."
    if quality.drop is not None:
        if quality.drop < 0:  # compression can smooth noise
            return f"Against the photos PSNR rose by {-quality.drop:.2f} dB ({over})."
        return f"Against the photos {quality.drop:.2f} dB of PSNR were lost ({over})."
    return (
        f"Its renders have a PSNR of {_decibel(quality.covered_fidelity)} against the original's, over what the original covers "
        f"({over}); there are no photos."
    )


def _quality_tiles(quality: Quality | None) -> list[tuple[str, str]]:
    if quality is None:
        return [("\u2013", "not measured: no cameras")]
    tiles = []
    if quality.drop is not None:
        tiles.append((f"{quality.drop:.2f} dB", "drop against the photos"))
    elif quality.covered_decides:
        words = f"modelled drop over what the original covers, from {quality.base_psnr:g} dB"
        tiles.append((f"{quality.covered_modelled_drop:.2f} dB", words))
    else:
        tiles.append((f"{quality.modelled_drop:.2f} dB", f"modelled drop, from {quality.base_psnr:g} dB"))
    tiles.append((_decibel(quality.fidelity), "fidelity"))
    covered = f"fidelity over what the original covers, {100 * quality.coverage:.3g} % of the pictures"
    tiles.append((_decibel(quality.covered_fidelity), covered))
    if quality.ssim_original is not None:
        tiles.append((f"{quality.ssim_original:.4f}", "SSIM against the original"))
    seen = quality.worst_flip
    if seen is not None:
        words = f"FLIP against the original; {figure(seen.flip_original, '.4f')} in its worst view, {seen.name}"
        tiles.append((f"{quality.flip_original:.4f}", words))
    return tiles


def _decibel(value: float | None) -> str:
    return "identical" if value is None else f"{value:.2f} dB"


def _channel_rows(contents: Mapping[str, Any]) -> list[tuple[str, int, list[object]]]:
    """Return name, bytes and table cells of each channel of a file, and of its other bytes."""
    size, packed = max(contents.get("size", 0), 1), contents.get("version") == 1
    rows: list[tuple[str, int, list[object]]] = []

    def add(name: str, taken: int, *more: object) -> None:
        rows.append((name, taken, [count(taken), f"{100 * taken / size:.1f} %", *more]))

    for name, item in (contents.get("channels") or {}).items():
        more = [item["bits"], item["groups"]] if packed else [figure(item[k], ".4g") for k in ("step", "bits_per_row")]
        add(name, item["bytes"], count(item["rows"]), *more)
    if rows:
        if contents.get("preview"):
            add("preview", contents["preview"]["bytes"], "", "", "")
        add("headers and checksums", contents["overhead_bytes"], "", "", "")
    return rows


def _compress_facts(result: CompressResult) -> list[tuple[str, object]]:
    facts = _scene_facts("scene", result.scene)
    facts.append(("file", result.output or "none (dry run)"))
    facts.append(("size", f"{count(result.size)} bytes{_size_words(result)}"))
    kept = f"{count(result.count)} of {count(result.scene.count)} Gaussians, {count(result.sh_count)} with SH"
    facts.append(("kept", f"{kept} (prune rate {result.prune_rate:g}, SH rate {result.sh_rate:g})"))
    facts.append(("method", result.method + (f", score {result.score}" if result.score else "")))
    if result.steps is not None:
        steps = (f"{name} {value:.3g}" for name, value in result.steps.items() if isinstance(value, float))
        facts.append(("grid steps", ", ".join(steps)))
    elif result.bits:
        facts.append(("bits", ", ".join(f"{name} {bits}" for name, bits in result.bits.items())))
    if result.target is not None:
        facts += [("target", result.target), ("decided by", decided_words(result))]
    return facts


def _size_words(result: CompressResult) -> str:
    scene, size = result.scene, result.size
    parts = [] if scene.plain or scene.bytes is None else [f"{times_words(scene.bytes / size)} than the input"]
    plain = times_words(scene.ply_bytes / size)
    parts.append(f"{plain} than a PLY" if parts else plain)
    return f", {', '.join(parts)} ({result.ratio_without_normals:.2f} times less than a PLY without normals)"


def _times_tile(ratio: float) -> tuple[str, str]:
    """Return the tile that says how many times smaller or larger a file is."""
    times, _, word = times_words(ratio).split(" ")
    return f"{times}\u00d7", word


def _scene_facts(label: str, scene: SceneInfo) -> list[tuple[str, object]]:
    words = f"{scene.path}: {count(scene.count)} Gaussians, SH degree {scene.sh_degree}, {format_size(scene.ply_bytes)} as PLY"
    if scene.bytes is not None and not scene.plain:
        words += f", {count(scene.bytes)} bytes as it lies there"
    return [(label, words), *(("note", note) for note in scene.notes)]


def _run_facts(run: RunInfo) -> list[tuple[str, object]]:
    facts: list[tuple[str, object]] = [
        ("took", f"{run.seconds:.1f} s, of these start-up of the device {run.startup_seconds:.1f} s"),
        ("memory", memory_words(run)),
    ]
    return facts if run.device is None else [*facts, ("device", device_words(run.device))]
