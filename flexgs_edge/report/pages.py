"""Make the HTML page of a `compress` or an `evaluate` from its result and pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import PurePath
from typing import Any

import numpy as np

from flexgs_edge.constants import FLIP_DEGREE
from flexgs_edge.goals.steps import Step
from flexgs_edge.goals.target import Target
from flexgs_edge.quality.view_quality import Quality
from flexgs_edge.report.html import count, figure, render
from flexgs_edge.report.material import ERROR_SCALE, FLIP_SCALE, Material, Rig, css_ramp
from flexgs_edge.report.results import CompressResult, EvaluateResult, decided_words
from flexgs_edge.report.run_info import RunInfo, SceneInfo
from flexgs_edge.report.summary import device_words, memory_words
from flexgs_edge.units import format_size, times_words

SIDE = 360  # Width of a plan in its own units: as wide as a phone, like the charts
WEDGE = 0.055  # Length of a camera's viewing wedge, as a share of the plan's width
ROOM = 0.06  # Empty margin, as a share of the plan's width
FAR = 0.35
"""The scene's points widen the plan by at most this share of the cameras' extent. Some scenes reach to the horizon."""
MOST_NAMES = 400
"""With more cameras than this, plans leave out the names that a pointer would show, so that pages stay small."""
# As wide as a phone, so that text stays readable there. On larger screens the chart and its text grow together.
WIDTH, HEIGHT = 360, 230
_LEFT, _RIGHT, _TOP, _BOTTOM = 44, WIDTH - 12, 14, HEIGHT - 38
FEW_ROWS = 16  # With more steps than this, their table is folded up. With more views, their table scrolls.


def plans(rig: Rig, numbers: Mapping[str, int]) -> str:
    """Draw both plans and their key."""
    across, away, up = axes(rig)
    low, high = extent(rig, np.stack([across, away, up]))
    # Both plans use one scale, so that they can be compared.
    scale = SIDE * (1 - 2 * ROOM) / max(float((high - low)[:2].max()), 1e-12)
    return render(
        "plans.html",
        plans=[
            _plan("seen from above", rig, (across, away), (low[[0, 1]], high[[0, 1]]), scale, 0),
            _plan("seen from the side", rig, (across, up), (low[[0, 2]], high[[0, 2]]), scale, 1),
        ],
        width=SIDE,
        numbers=numbers,
        named=len(rig.names) <= MOST_NAMES,
        training=len(rig.names) - len(rig.held_out),
        held_out=len(rig.held_out),
        points=len(rig.points),
    )


def axes(rig: Rig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vectors [3] of the plan's axes in the world: across, away and up.

    Away points from the viewer of the side plan into the scene. Up is the mean up direction of the cameras. If those cancel
    out, up is the direction in which camera positions vary least.
    """
    centred = rig.centers - rig.centers.mean(axis=0)
    up = -rig.rotations[:, 1, :].mean(axis=0)
    if np.linalg.norm(up) < 0.1:
        up = np.linalg.svd(centred, full_matrices=True)[2][2]
    up = up / np.linalg.norm(up)
    flat = centred - np.outer(centred @ up, up)
    across = np.linalg.svd(flat, full_matrices=True)[2][0]
    across = across - (across @ up) * up
    if np.linalg.norm(flat) < 1e-9 or np.linalg.norm(across) < 1e-6:
        # All cameras stand in one place: use right or forward of the first camera, whichever is less parallel to up.
        right, forward = rig.rotations[0, 0], rig.rotations[0, 2]
        across = max((axis - (axis @ up) * up for axis in (right, forward)), key=lambda axis: float(axis @ axis))
    across = across / np.linalg.norm(across)
    if across[np.argmax(np.abs(across))] < 0:
        across = -across
    return across, np.cross(up, across), up


def extent(rig: Rig, basis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ends [3] of the plan along the rows of `basis`: all cameras, and the middle of the scene as far as `FAR` allows."""
    places = rig.centers @ basis.T
    low, high = places.min(axis=0), places.max(axis=0)
    if len(rig.points):
        inner = np.percentile(rig.points @ basis.T, (5, 95), axis=0)
        size = float((high - low).max())
        reach = FAR * size if size > 0 else np.inf
        low = np.minimum(low, np.maximum(inner[0], low - reach))
        high = np.maximum(high, np.minimum(inner[1], high + reach))
    # A single camera without a scene has no extent: add a margin.
    if float((high - low).max()) == 0.0:
        low, high = low - 1.0, high + 1.0
    return low, high


def _plan(
    title: str,
    rig: Rig,
    basis: tuple[np.ndarray, np.ndarray],
    ends: tuple[np.ndarray, np.ndarray],
    scale: float,
    half: int,
) -> dict[str, Any]:
    """Compute the positions of one plan. `half` chooses the half angle of the wedges: 0 of the width, 1 of the height."""
    rows = np.stack(basis)
    low, high = ends
    rim = ROOM * SIDE
    size = float(scale * (high - low)[1])
    height = min(max(size + 2 * rim, SIDE / 4), SIDE)
    # Centre the plan: the extent does not fill its shorter side.
    offset = np.array([(SIDE - scale * (high - low)[0]) / 2, (height - size) / 2])

    def at(points: np.ndarray) -> np.ndarray:
        flat: np.ndarray = (points @ rows.T - low) * scale + offset
        flat[:, 1] = height - flat[:, 1]
        return flat

    length = WEDGE * SIDE / scale
    forward, side = rig.rotations[:, 2, :], rig.rotations[:, half, :]
    reach = np.minimum(rig.reach[:, half], 1.5)[:, None]
    feet = at(rig.centers)
    left, right = (at(rig.centers + length * (forward + sign * reach * side)) for sign in (-1, 1))
    # Draw the held-out cameras last: they are few and must stay visible.
    order = sorted(range(len(rig.names)), key=lambda i: (i in rig.held_out, i))
    return {
        "title": title,
        "height": height,
        "dots": _dots(at(rig.points), height) if len(rig.points) else [],
        "stands": [
            {
                "name": rig.names[i],
                "held_out": i in rig.held_out,
                "foot": tuple(feet[i]),
                "left": tuple(left[i]),
                "right": tuple(right[i]),
                "label": np.clip(feet[i] + (5, -5), (2, 12), (SIDE - 12, height - 4)),
            }
            for i in order
        ],
    }


def _dots(points: np.ndarray, height: float) -> list[tuple[int, int]]:
    """Round points to whole positions within the plan, each once."""
    inside = points[((points >= 0) & (points <= (SIDE, height))).all(axis=1)]
    return list(dict.fromkeys((round(x), round(y)) for x, y in inside))


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
    unit, word = _unit(high_x)

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


def _unit(most: float) -> tuple[int, str]:
    for scale, word in ((10**9, "GB"), (10**6, "MB"), (10**3, "kB")):
        if most >= scale:
            return scale, word
    return 1, "bytes"


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
    rig, shown = material.rig, {}
    if rig is not None:
        shown = {rig.names[shot.camera]: number for number, shot in enumerate(material.shots, start=1)}
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
        "error_ramp": css_ramp(),
        "channels": _channel_rows(material.contents or {}),
        "camera_plans": plans(rig, shown) if rig is not None and result.views is not None else "",
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
