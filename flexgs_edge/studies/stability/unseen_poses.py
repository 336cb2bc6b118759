"""Experiments on poses that were not scored: nearer and farther, in between, above, with other lenses and sizes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.generated import at_distance, between
from flexgs_edge.quality.psnr import mean_psnr, mse, psnr
from flexgs_edge.report.plots import BarChart, LineChart
from flexgs_edge.run.few_poses import evenly
from flexgs_edge.studies.result_tables import Cell, Experiment, Row, Table, columns
from flexgs_edge.studies.stability.ours import BEST, BREAK, LOST, WORDS, Contenders, curve, number
from flexgs_edge.studies.study_scene import StudyScene
from flexgs_edge.views.depths import visible_depths

TILE_SIDE = 64
TURNS = (15.0, 30.0)  # Degrees by which a pose is turned up about the point that it looks at
ZOOMS = (0.5, 2.0, 4.0)
SIZES = (0.5, 2.0)
TRAINING, HELD_OUT, DISTANCE = "training", "held out", "distance"
HEADS = {
    "method": "method",
    "poses": "poses",
    "amount": "times, or degrees",
    "views": "views",
    "fidelity": "fidelity (dB)",
    "worst": "worst view (dB)",
    "tile": f"worst tile of {TILE_SIDE}x{TILE_SIDE} (dB)",
    "below": "below its training poses (dB)",
    "broke": "broken by",
}


@dataclass(frozen=True)
class Amounts:
    """The points of every experiment."""

    width: int | None = None  # Most pixels that views are wide. None (default): as `--resolution` says.
    # Factors on the distance from a camera to the scene.
    distances: tuple[float, ...] = (0.25, 0.5, 0.71, 1.0, 1.41, 2.0, 4.0)
    poses: int = 4  # how many held-out views other poses are made from
    even: bool = True  # also let the even held-out views decide, and judge on the odd ones


FULL = Amounts()
QUICK = Amounts(width=120, distances=(0.5, 1.0, 2.0), poses=2, even=False)  # A quick look at every experiment


@dataclass(frozen=True)
class Poses:
    """A set of cameras, and how it was made."""

    kind: str
    amount: float | None
    cameras: list[Camera]


def above(camera: Camera, depth: float, degrees: float) -> Camera:
    """The pose turned up about the point at `depth` on its axis, and still looking there."""
    angle = math.radians(degrees)
    turn = np.array(
        [[1, 0, 0], [0, math.cos(angle), -math.sin(angle)], [0, math.sin(angle), math.cos(angle)]]
    )  # [3, 3] about the image's x
    pivot = np.array([0.0, 0.0, depth])
    return replace(camera, rotation=turn @ camera.rotation, translation=turn @ (camera.translation - pivot) + pivot)


def make_poses(studied: StudyScene, amounts: Amounts) -> list[Poses]:
    """All sets, the training poses first."""
    train = studied.views.of(studied.views.train)
    base = evenly(studied.judge.cameras, amounts.poses)
    depths = visible_depths(studied.context.renderer, studied.run.source, base)
    near = [min(train, key=lambda other: float(np.linalg.norm(other.center - camera.center))) for camera in base]
    made = [Poses(TRAINING, None, evenly(train, amounts.poses)), Poses(HELD_OUT, None, base)]
    made += [
        Poses(DISTANCE, factor, [at_distance(camera, depth, factor) for camera, depth in zip(base, depths)])
        for factor in amounts.distances
        if factor != 1.0
    ]
    made.append(Poses("between", None, [between(camera, other) for camera, other in zip(base, near)]))
    made += [Poses("above", turn, [above(c, depth, turn) for c, depth in zip(base, depths)]) for turn in TURNS]
    made += [Poses("focal length", f, [replace(c, fx=f * c.fx, fy=f * c.fy) for c in base]) for f in ZOOMS]
    made += [Poses("resolution", f, [_sized(c, f) for c in base]) for f in SIZES]
    return made


def _sized(camera: Camera, factor: float) -> Camera:
    return camera.scaled(max(round(factor * camera.width), 1), max(round(factor * camera.height), 1))


def worst_tile(image: np.ndarray, reference: np.ndarray, side: int = TILE_SIDE) -> float:
    """Largest mean squared error of a tile, between two [H, W, 3] images clamped to [0, 1]. Tiles at the edges may be smaller."""
    square = np.square(np.clip(image, 0.0, 1.0).astype(np.float64) - np.clip(reference, 0.0, 1.0)).sum(axis=2)
    height, width = square.shape
    rows, across = np.arange(0, height, side), np.arange(0, width, side)
    sums = np.add.reduceat(np.add.reduceat(square, rows, axis=0), across, axis=1)
    pixels = np.minimum(side, height - rows)[:, None] * np.minimum(side, width - across)
    return float((sums / (3 * pixels)).max())


@dataclass(frozen=True)
class Seen:
    """Mean squared errors of views against the original's renders, and of their worst tiles."""

    errors: list[float]
    tiles: list[float]

    def cells(self) -> dict[str, Cell]:
        """Fidelity in dB: mean over the views, worst view and worst tile."""
        mean = mean_psnr([psnr(error) for error in self.errors])
        figures = {"fidelity": mean, "worst": psnr(max(self.errors)), "tile": psnr(max(self.tiles))}
        return {name: None if value is None else round(value, 3) for name, value in figures.items()}


def look(studied: StudyScene, contenders: Contenders, cameras: Sequence[Camera]) -> dict[str, Seen]:
    """Compare all contenders with the original over some views."""
    renderer = studied.context.renderer
    with renderer.load(studied.run.source) as scene:
        originals = [renderer.render(scene, camera) for camera in cameras]
    found = {}
    for name in contenders.names:
        errors, tiles = [], []
        with contenders.loaded(name) as scene:
            for camera, original in zip(cameras, originals):
                image = renderer.render(scene, camera)
                errors.append(mse(image, original))
                tiles.append(worst_tile(image, original))
        found[name] = Seen(errors, tiles)
    renderer.release()
    return found


def poses(studied: StudyScene, contenders: Contenders, amounts: Amounts) -> list[Experiment]:
    """Measure fidelity from poses that were not scored, by distance and by kind."""
    rows: list[dict[str, Cell]] = []
    base: dict[str, float] = {}
    every = make_poses(studied, amounts)
    for made in studied.run.progress.track(every, "poses", len(every)):
        for name, seen in look(studied, contenders, made.cameras).items():
            cells = seen.cells()
            # Identical pictures have no finite fidelity, so nothing can be compared with them.
            fidelity = math.inf if cells["fidelity"] is None else number(cells, "fidelity")
            below = base.setdefault(name, fidelity) - fidelity
            rows.append(
                {
                    "method": name,
                    "poses": made.kind,
                    "amount": made.amount,
                    "views": len(made.cameras),
                    **cells,
                    "below": round(below, 3) if math.isfinite(below) else None,
                    "broke": LOST if below > BREAK else None,
                }
            )
    by_distance = [row for row in rows if row["poses"] in (TRAINING, HELD_OUT, DISTANCE)]
    others = [row for row in rows if row["poses"] != DISTANCE]
    return [_by_distance(by_distance, contenders, base[BEST]), _by_kind(others, contenders)]


_LOOK = (
    "Fidelity to the original's renders: mean over the views, worst view, and worst tile of "
    f"{TILE_SIDE}x{TILE_SIDE} pixels. A method has broken if it is more than {BREAK:g} dB below its own fidelity at "
    "training poses. "
)


def _by_distance(rows: list[dict[str, Cell]], contenders: Contenders, base: float) -> Experiment:
    table = Table(columns(**HEADS), tuple(rows))
    series = {}
    for name in contenders.names:
        own = [row for row in rows if row["method"] == name and row["poses"] != TRAINING]
        places = [{**row, "amount": 1.0 if row["poses"] == HELD_OUT else row["amount"]} for row in own]
        series[name] = sorted(places, key=lambda row: number(row, "amount"))
    return Experiment(
        "distance",
        "Nearer and farther",
        "Held-out poses are moved along their axes, to so many times the distance of the middle of the frame. "
        + _LOOK
        + WORDS,
        table,
        LineChart(
            "Poses nearer and farther than the scored ones",
            "distance to the scene, times",
            "fidelity (dB)",
            tuple(curve(part, name, "amount", "fidelity", every=True) for name, part in series.items()),
            limit=round(base - BREAK, 2) if math.isfinite(base) else None,
            doublings=True,
            floating=True,
        ),
        tuple(_near_and_far(part, name) for name, part in series.items()),
    )


def _near_and_far(rows: Sequence[Row], name: str) -> str:
    """A sentence: from which distances, nearer and farther, a method still stands."""
    broken = [row for row in rows if row["broke"] is not None]
    words = ", ".join(f"{number(row, 'amount'):g}x ({_below(row)})" for row in broken)
    gentle = ", ".join(f"{number(row, 'amount'):g}x {_below(row)}" for row in rows if row["amount"] in (0.5, 2.0))
    return f"{name}: {gentle}; " + (f"broken at {words}." if broken else "stands everywhere.")


def _below(row: Row) -> str:
    if row["below"] is None:
        return "identical"
    below = number(row, "below")
    return f"{abs(below):.1f} dB {'below' if below >= 0 else 'above'} its training poses"


def _by_kind(rows: list[dict[str, Cell]], contenders: Contenders) -> Experiment:
    table = Table(columns(**HEADS), tuple(rows))
    kinds = list(dict.fromkeys((row["poses"], row["amount"]) for row in rows))
    findings = []
    for name in contenders.names:
        own = [row for row in rows if row["method"] == name]
        broken = [f"{_kind(row)} ({_below(row)})" for row in own if row["broke"] is not None]
        tiles = {row["poses"]: row["tile"] for row in own if row["poses"] in (TRAINING, HELD_OUT)}
        findings.append(
            f"{name}: {'broken at ' + ', '.join(broken) if broken else 'stands everywhere'}; worst tile "
            f"{tiles[TRAINING]} dB at training poses, {tiles[HELD_OUT]} dB at held-out ones."
        )
    return Experiment(
        "poses",
        "Between and above the path, other lenses and sizes",
        "Training poses, held-out ones, poses half way between each of these and the nearest training pose, turned up "
        "about what they look "
        "at, with other focal lengths and in other resolutions. " + _LOOK + WORDS,
        table,
        BarChart(
            "Poses beside the path, other lenses and sizes",
            "below the method's training poses (dB)",
            [_kind({"poses": kind, "amount": amount}).replace(" ", "\n") for kind, amount in kinds if kind != TRAINING],
            {
                name: [
                    None if cell is None else float(cell)
                    for kind, amount in kinds
                    if kind != TRAINING
                    for cell in table.values("below", method=name, poses=kind, amount=amount)
                ]
                for name in contenders.names
            },
            limit=BREAK,
            digits=1,
        ),
        tuple(findings),
    )


def _kind(row: Row) -> str:
    return str(row["poses"]) if row["amount"] is None else f"{row['poses']} {number(row, 'amount'):g}"
