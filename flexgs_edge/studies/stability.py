"""`study stability`: where compressed scenes break, on held-out views and from poses beside them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.generated import at_distance, between
from flexgs_edge.commands.compress import compress
from flexgs_edge.goals.promise import WORST_MORE, WORST_TIMES
from flexgs_edge.goals.target import Figure
from flexgs_edge.progress import LOG, SILENT, Progress
from flexgs_edge.quality.psnr import mean_psnr, mse, psnr
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.report.as_json import rounded
from flexgs_edge.report.plots import BarChart, LineChart, Series
from flexgs_edge.report.results import CompressResult
from flexgs_edge.run.few_poses import evenly, visible_depths
from flexgs_edge.run.inputs import load_scene
from flexgs_edge.run.open_renderer import open_renderer
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.quality_evaluator import measurement_of
from flexgs_edge.run.run import Run, open_run
from flexgs_edge.scene.source import SceneSource
from flexgs_edge.studies import written

BREAK = 3.0  # A method has broken if it loses more than this, in dB: twice the squared error
LOST = f"lost {BREAK:g} dB"
METHODS: dict[str, dict[str, Any]] = {
    "best": {"method": "best"},
    "best, --promise mean": {"method": "best", "promise": "mean"},
    "paper": {"method": "paper"},
}  # What is compared, and its options
EFFORT = "fast"  # Breaks show at every effort
TILE_SIDE = 64
TURNS = (15.0, 30.0)  # Degrees by which a pose is turned up about the point that it looks at
ZOOMS = (0.5, 2.0, 4.0)
SIZES = (0.5, 2.0)
TRAINING, HELD_OUT, DISTANCE = "training", "held out", "distance"
VIEW_HEADS = {
    "method": "method",
    **written.FIGURES,
    "worst": "loss of the worst view (dB)",
    "allowed": "allowed for the worst (dB)",
    "within": "within",
    "view": "worst view",
    "broke": "broken by",
}
POSE_HEADS = {
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
_INTRO = (
    "Where methods break: at a loss of more than 3 dB. Charts cross out such points, and the dashed line is the limit. All "
    "files are drawn by the same renderer. Means over few views hide single bad ones, so the worst view, and where it matters "
    "the worst tile, are shown beside them."
)
_LOOK = (
    "Fidelity to the original's renders: mean over the views, worst view, and worst tile of "
    f"{TILE_SIDE}x{TILE_SIDE} pixels. A method has broken if it is more than {BREAK:g} dB below its own fidelity at "
    "training poses."
)


@dataclass(frozen=True)
class Amounts:
    """The points of every experiment."""

    width: int | None = None  # Most pixels that views are wide. None (default): as `--resolution` says.
    # Factors on the distance from a camera to the scene.
    distances: tuple[float, ...] = (0.25, 0.5, 0.71, 1.0, 1.41, 2.0, 4.0)
    poses: int = 4  # how many held-out views other poses are made from


FULL = Amounts()
QUICK = Amounts(width=120, distances=(0.5, 1.0, 2.0), poses=2)  # A quick look at every experiment


def study_stability(
    scene: str | Path,
    output: str | Path,
    options: CompressOptions | None = None,
    progress: Progress = SILENT,
    quick: bool = False,
    amounts: Amounts | None = None,
    **words: Any,
) -> written.Study:
    """Find the conditions under which methods break on a scene, and write them to a folder."""
    options = replace(options or CompressOptions(), **words)
    amounts = amounts or (QUICK if quick else FULL)
    if amounts.width is not None:
        options = replace(options, resolution=min(options.resolution, amounts.width))

    def make(folder: Path) -> written.SceneStudy:
        found: dict[str, CompressResult] = {}
        for place, (name, own) in enumerate(METHODS.items()):
            LOG.info("compressing: %s", name)
            asked = replace(options, effort=EFFORT, best_effort=True, report=None, dry_run=False, **own)
            found[name] = compress(scene, folder / f"{place}.fgs", asked, progress)
        return written.SceneStudy.of(
            scene, found["best"], held_out(found), *poses(scene, options, progress, found, amounts)
        )

    return written.write_study("study stability", output, options.force, "Stability", _INTRO, make)


def held_out(found: dict[str, CompressResult]) -> written.Experiment:
    """Compare the methods by the mean and the worst of the held-out views."""
    rows = [_view_row(name, result) for name, result in found.items()]
    table = written.Table(VIEW_HEADS, tuple(rows))
    figure = "modelled_drop" if rows[0]["drop"] is None else "drop"
    return written.Experiment(
        "heldout",
        "The worst view",
        f"The results at the study's target, over the held-out views. A worst view within {WORST_TIMES:g} times the mean plus "
        f"{WORST_MORE:g} dB counts as within. best keeps the whole promise, which bounds the worst view and generated poses.",
        table,
        BarChart(
            "Mean and worst held-out view",
            f"loss: {written.FIGURES[figure]}",
            [str(row["method"]).replace(", ", ",\n") for row in rows],
            {"mean": table.values(figure), "worst view": table.values("worst")},
            limit=BREAK,
        ),
        tuple(
            f"{row['method']}: {row['ratio']:g}x, mean {row[figure]} dB, worst view {row['view']} {row['worst']} dB, allowed "
            f"{row['allowed']} dB: {'within' if row['within'] else 'NOT within'}."
            for row in rows
        ),
    )


def _view_row(name: str, result: CompressResult) -> dict[str, written.Cell]:
    quality = result.quality
    assert quality is not None and quality.worst is not None
    measured = measurement_of(quality)
    assert measured.worst is not None
    figure: Figure = "modelled drop" if measured.drop is None else "drop"
    worst, allowed = measured.worst.loss(figure), WORST_TIMES * max(measured.loss(figure), 0.0) + WORST_MORE
    return {
        "method": name,
        **written.figures(result.size, result.scene.ply_bytes, measured),
        "worst": round(worst, 4),
        "allowed": round(allowed, 4),
        "within": worst <= allowed,
        "view": quality.worst.name,
        "broke": LOST if worst > BREAK else None,
    }


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


def make_poses(run: Run[CompressOptions], renderer: Renderer, amounts: Amounts) -> list[Poses]:
    """All sets, the training poses first."""
    views = run.seen
    train = views.of(views.train or views.held_out)
    base = evenly(views.of(views.held_out or views.train), amounts.poses)
    depths = visible_depths(renderer, run.source, base)
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
    for f in SIZES:
        made.append(
            Poses("resolution", f, [c.scaled(max(round(f * c.width), 1), max(round(f * c.height), 1)) for c in base])
        )
    return made


def worst_tile(image: np.ndarray, reference: np.ndarray, side: int = TILE_SIDE) -> float:
    """Largest mean squared error of a tile, between two [H, W, 3] images clamped to [0, 1]. Tiles at the edges may be smaller."""
    square = np.square(np.clip(image, 0.0, 1.0).astype(np.float64) - np.clip(reference, 0.0, 1.0)).sum(axis=2)
    height, width = square.shape
    rows, across = np.arange(0, height, side), np.arange(0, width, side)
    sums = np.add.reduceat(np.add.reduceat(square, rows, axis=0), across, axis=1)
    pixels = np.minimum(side, height - rows)[:, None] * np.minimum(side, width - across)
    return float((sums / (3 * pixels)).max())


def look(
    renderer: Renderer, original: SceneSource, others: dict[str, SceneSource], cameras: Sequence[Camera]
) -> dict[str, dict[str, written.Cell]]:
    """Fidelity of all scenes to the original over some views, in dB: mean, worst view and worst tile."""
    with renderer.load(original) as scene:
        references = [renderer.render(scene, camera) for camera in cameras]
    found: dict[str, dict[str, written.Cell]] = {}
    for name, source in others.items():
        with renderer.load(source) as scene:
            pairs = [(renderer.render(scene, camera), one) for camera, one in zip(cameras, references)]
        errors = [mse(image, reference) for image, reference in pairs]
        tile = psnr(max(worst_tile(image, reference) for image, reference in pairs))
        mean, worst = mean_psnr([psnr(error) for error in errors]), psnr(max(errors))
        found[name] = {"fidelity": rounded(mean, 3), "worst": rounded(worst, 3), "tile": rounded(tile, 3)}
    renderer.release()
    return found


def poses(
    scene: str | Path, options: CompressOptions, progress: Progress, found: dict[str, CompressResult], amounts: Amounts
) -> list[written.Experiment]:
    """Measure fidelity from poses that were not scored, by distance and by kind."""
    run = open_run(scene, options, progress, photos=False)
    files = {name: load_scene(result.output or "").source for name, result in found.items()}
    rows: list[dict[str, written.Cell]] = []
    base: dict[str, float] = {}
    with open_renderer(run) as renderer:
        every = make_poses(run, renderer, amounts)
        for made in progress.track(every, "poses", len(every)):
            for name, cells in look(renderer, run.source, files, made.cameras).items():
                # Identical pictures have no finite fidelity, so nothing can be compared with them.
                fidelity = math.inf if cells["fidelity"] is None else written.number(cells, "fidelity")
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
    return [_by_distance(by_distance, base["best"]), _by_kind(others)]


def _by_distance(rows: list[dict[str, written.Cell]], base: float) -> written.Experiment:
    series, findings = [], []
    for name in METHODS:
        own = [row for row in rows if row["method"] == name and row["poses"] != TRAINING]
        places = [{**row, "amount": 1.0 if row["poses"] == HELD_OUT else row["amount"]} for row in own]
        places.sort(key=lambda row: written.number(row, "amount"))
        series.append(
            Series(
                name,
                [written.number(row, "amount") for row in places],
                [None if row["fidelity"] is None else written.number(row, "fidelity") for row in places],
                broken=[written.number(row, "amount") for row in places if row["broke"] is not None],
            )
        )
        findings.append(_near_and_far(places, name))
    return written.Experiment(
        "distance",
        "Nearer and farther",
        "Held-out poses are moved along their axes, to so many times the distance of the middle of the frame. " + _LOOK,
        written.Table(POSE_HEADS, tuple(rows)),
        LineChart(
            "Poses nearer and farther than the scored ones",
            "distance to the scene, times",
            "fidelity (dB)",
            tuple(series),
            limit=round(base - BREAK, 2) if math.isfinite(base) else None,
            doublings=True,
            floating=True,
        ),
        tuple(findings),
    )


def _near_and_far(rows: Sequence[written.Row], name: str) -> str:
    """A sentence: from which distances, nearer and farther, a method still stands."""
    broken = [row for row in rows if row["broke"] is not None]
    words = ", ".join(f"{written.number(row, 'amount'):g}x ({_below(row)})" for row in broken)
    gentle = ", ".join(
        f"{written.number(row, 'amount'):g}x {_below(row)}" for row in rows if row["amount"] in (0.5, 2.0)
    )
    return f"{name}: {gentle}; " + (f"broken at {words}." if broken else "stands everywhere.")


def _below(row: written.Row) -> str:
    if row["below"] is None:
        return "identical"
    below = written.number(row, "below")
    return f"{abs(below):.1f} dB {'below' if below >= 0 else 'above'} its training poses"


def _by_kind(rows: list[dict[str, written.Cell]]) -> written.Experiment:
    table = written.Table(POSE_HEADS, tuple(rows))
    kinds = [kind for kind in dict.fromkeys((row["poses"], row["amount"]) for row in rows) if kind[0] != TRAINING]
    findings = []
    for name in METHODS:
        own = [row for row in rows if row["method"] == name]
        broken = [f"{_kind(row)} ({_below(row)})" for row in own if row["broke"] is not None]
        tiles = {row["poses"]: row["tile"] for row in own if row["poses"] in (TRAINING, HELD_OUT)}
        findings.append(
            f"{name}: {'broken at ' + ', '.join(broken) if broken else 'stands everywhere'}; worst tile "
            f"{tiles[TRAINING]} dB at training poses, {tiles[HELD_OUT]} dB at held-out ones."
        )
    return written.Experiment(
        "poses",
        "Between and above the path, other lenses and sizes",
        "Training poses, held-out ones, poses half way between each of these and the nearest training pose, turned up "
        "about what they look at, with other focal lengths and in other resolutions. " + _LOOK,
        table,
        BarChart(
            "Poses beside the path, other lenses and sizes",
            "below the method's training poses (dB)",
            [_kind({"poses": kind, "amount": amount}).replace(" ", "\n") for kind, amount in kinds],
            {
                name: [
                    cell
                    for kind, amount in kinds
                    for cell in table.values("below", method=name, poses=kind, amount=amount)
                ]
                for name in METHODS
            },
            limit=BREAK,
            digits=1,
        ),
        tuple(findings),
    )


def _kind(row: written.Row) -> str:
    return str(row["poses"]) if row["amount"] is None else f"{row['poses']} {written.number(row, 'amount'):g}"
