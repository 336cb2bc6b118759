"""Times faster but less exact ways to draw: fewer SH, fewer splats, other extents, half precision, small pictures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.quality.psnr import mean_psnr, mse, psnr
from flexgs_edge.render.renderer import EXTENTS, Renderer
from flexgs_edge.report.plots import LineChart, Series
from flexgs_edge.scene.fields import sh_rest_count
from flexgs_edge.scene.source import Planes, Rows, SceneSource
from flexgs_edge.studies.experiment import Experiment
from flexgs_edge.studies.result_tables import Cell, Table, columns
from flexgs_edge.studies.speed.front import front
from flexgs_edge.studies.speed.timing import draw_seconds, median
from flexgs_edge.studies.study_scene import StudyScene
from flexgs_edge.views.references import to_half

REPEATS = 5
"""Rounds over all settings. The shortest time of each counts, because other work on the machine only adds time."""
THRESHOLDS = (1, 4, 8, 16)
"""Least opacities, in 255ths; splats below them are left out."""
SHRINKS = (2, 4)
"""Divisors of both sides of the picture."""
CHUNK = 1 << 16
EXACT = "exact"


class LowerDegree(SceneSource):
    """A scene with SH only up to a lower degree."""

    def __init__(self, parent: SceneSource, degree: int) -> None:
        self.parent, self.sh_degree = parent, degree
        self.name, self.origin, self.notes = parent.name, parent.origin, parent.notes
        self.count, self.sh_count = parent.count, parent.sh_count if degree else 0

    def read(self, rows: Rows, fields: Sequence[str], out: Planes | None = None) -> Planes:
        """See `SceneSource.read`."""
        rows, planes = self.begin_read(rows, fields, out)
        self.parent.read(rows, [name for name in planes if name != "sh_rest"], planes)
        if "sh_rest" in planes:
            whole = self.parent.read(rows, ["sh_rest"])["sh_rest"]
            bands = whole.reshape(3, sh_rest_count(self.parent.sh_degree), -1)[:, : sh_rest_count(self.sh_degree)]
            planes["sh_rest"][...] = bands.reshape(planes["sh_rest"].shape)
        return planes


class HalfPrecision(SceneSource):
    """A scene whose stored values are rounded to half precision (positions relative to the scene's origin)."""

    def __init__(self, parent: SceneSource) -> None:
        self.parent, self.sh_degree = parent, parent.sh_degree
        self.name, self.origin, self.notes = parent.name, parent.origin, parent.notes
        self.count, self.sh_count = parent.count, parent.sh_count

    def read(self, rows: Rows, fields: Sequence[str], out: Planes | None = None) -> Planes:
        """See `SceneSource.read`."""
        rows, planes = self.begin_read(rows, fields, out)
        self.parent.read(rows, fields, planes)
        for plane in planes.values():
            # Infinite values could not be drawn, but saturated ones can.
            plane[...] = to_half(plane)
        return planes


@dataclass(frozen=True)
class Way:
    """A way to draw the scene.

    `kind`, `name`: what is reduced, and to what.
    """

    kind: str
    name: str
    source: SceneSource  # the scene to draw
    extent: str  # extent of splats, as for the renderer
    shrink: int = 1  # divisor of both sides of the picture

    def cameras(self, views: Sequence[Camera]) -> list[Camera]:
        """The views at the size at which they are drawn."""
        shrink = self.shrink
        return [view.scaled(max(view.width // shrink, 1), max(view.height // shrink, 1)) for view in views]


def ways(source: SceneSource, extent: str) -> Iterator[Way]:
    """The exact way first, then all others that make sense for this scene."""
    yield Way(EXACT, EXACT, source, extent)
    for degree in range(source.sh_degree):
        yield Way("SH degree", str(degree), LowerDegree(source, degree), extent)
    opacity = _opacity(source)
    for level in THRESHOLDS:
        rows = np.flatnonzero(opacity >= level / 255.0)
        if len(rows):
            yield Way("opacity from", f"{level}/255", source.select(rows), extent)
    for other in EXTENTS:
        if other != extent:
            yield Way("extent", other, source, other)
    yield Way("half precision", "float16", HalfPrecision(source), extent)
    for shrink in SHRINKS:
        yield Way("resolution", f"1/{shrink}", source, extent, shrink)


def drawing(studied: StudyScene, repeats: int = REPEATS) -> Experiment:
    """Measure the time of a view, and its PSNR against the exact view."""
    options, judge = studied.run.options, studied.judge
    assert options.near is not None and options.background is not None and options.extent is not None
    backend = studied.bench.renderer.backend
    every = list(ways(studied.run.source, options.extent))
    seconds: list[list[float]] = [[] for _ in every]
    errors: list[list[float]] = [[] for _ in every]
    renderers = {options.extent: studied.bench.renderer}
    for extent in EXTENTS:
        if extent not in renderers:
            renderers[extent] = Renderer(
                backend,
                studied.run.budget,
                options.near,
                options.background,
                extent,
                bool(options.antialiased),
            )
    for turn in studied.run.progress.track(range(repeats), "drawing", repeats):
        for place, way in enumerate(every):
            renderer, cameras = renderers[way.extent], way.cameras(judge.cameras)
            with renderer.load(way.source) as scene:
                seconds[place].append(draw_seconds(renderer, scene, cameras) / len(cameras))
                if turn == 0:
                    errors[place] = [
                        _error(renderer.render(scene, c), judge.original(i)) for i, c in enumerate(cameras)
                    ]
            renderer.release()  # the next renderer needs this memory: both share one budget
    rows = _rows(every, seconds, errors, len(judge.cameras))
    return _experiment(studied, every, rows, repeats)


def _rows(
    every: Sequence[Way], seconds: Sequence[Sequence[float]], errors: Sequence[Sequence[float]], views: int
) -> list[dict[str, Cell]]:
    times = [min(passes) for passes in seconds]
    figures = [mean_psnr([psnr(error) for error in of_way]) for of_way in errors]
    best = front(times, [float("inf") if figure is None else figure for figure in figures])
    return [
        {
            "kind": way.kind,
            "setting": way.name,
            "gaussians": way.source.count,
            "ms": round(1e3 * time, 3),
            "median_ms": round(1e3 * median(passes), 3),
            "most_ms": round(1e3 * max(passes), 3),
            "share": round(time / times[0], 4),
            "psnr": None if figure is None else round(figure, 3),
            "identical": sum(error == 0.0 for error in of_way),
            "front": on,
        }
        for way, time, passes, figure, of_way, on in zip(every, times, seconds, figures, errors, best)
    ]


def _experiment(studied: StudyScene, every: Sequence[Way], rows: list[dict[str, Cell]], repeats: int) -> Experiment:
    table = Table(
        columns(
            kind="what is less",
            setting="setting",
            gaussians="Gaussians",
            ms="ms a view",
            median_ms="median",
            most_ms="most",
            share="of the exact time",
            psnr="PSNR to the exact view (dB)",
            identical="views identical",
            front="on the front",
        ),
        tuple(rows),
    )
    kinds = [kind for kind in dict.fromkeys(way.kind for way in every) if kind != EXACT]
    shown = [row for row in rows if row["psnr"] is not None]
    exact = rows[0]
    return Experiment(
        "drawing",
        "Time of a view and what it is worth",
        f"The {len(studied.judge.cameras)} deciding views ({studied.judge.cameras[0].width}x{studied.judge.cameras[0].height}), "
        "drawn whole and read back, in less exact ways. PSNR is against the exact views, mean over the views that differ. "
        f"Times are the shortest of {repeats} rounds over all settings, with the scene loaded. Splats below an opacity of 1/255 "
        "never show. Half precision is about stored values; they are drawn in single precision, in the time of the exact "
        "view. Small pictures are enlarged bilinearly for the comparison, which is not timed.",
        table,
        LineChart(
            "Time of a view against its PSNR",
            "ms a view (log)",
            "PSNR to the exact view (dB)",
            tuple(
                Series(
                    kind,
                    table.values("ms", kind=kind),
                    table.values("psnr", kind=kind),
                    line=False,
                    notes=table.values("setting", kind=kind),
                )
                for kind in kinds
                if any(value is not None for value in table.values("psnr", kind=kind))
            ),
            log_x=True,
            floating=True,
            front=[(float(row["ms"] or 0), float(row["psnr"] or 0)) for row in shown if row["front"]],
            upright=(float(exact["ms"] or 0), "exact"),
        ),
        (
            f"The exact view takes {exact['ms']:.1f} ms.",
            *(
                f"{kind}: "
                + "; ".join(
                    f"{row['setting']} {100 * float(row['share'] or 0):.0f} % of the time, "
                    + ("identical" if row["psnr"] is None else f"{row['psnr']:.1f} dB")
                    for row in rows
                    if row["kind"] == kind
                )
                + "."
                for kind in kinds
            ),
            "On the front: "
            + ", ".join(
                EXACT if row["kind"] == EXACT else f"{row['kind']} {row['setting']}" for row in rows if row["front"]
            )
            + ".",
        ),
        timed=True,
    )


def _opacity(source: SceneSource) -> np.ndarray:
    """[N] f64, opacities in (0, 1)."""
    opacity = np.empty(source.count)
    for rows in source.chunks(CHUNK):
        logits = source.read(rows, ["opacity_logits"])["opacity_logits"][0].astype(np.float64)
        opacity[rows] = np.exp(-np.logaddexp(0.0, -logits))
    return opacity


def _error(image: np.ndarray, exact: np.ndarray) -> float:
    return mse(_enlarged(image, exact), exact)


def _enlarged(image: np.ndarray, like: np.ndarray) -> np.ndarray:
    """The image, enlarged to the size of `like`, bilinear between pixel centres."""
    if image.shape == like.shape:
        return image
    for axis in (0, 1):
        size = like.shape[axis]
        place = np.clip((np.arange(size) + 0.5) * (image.shape[axis] / size) - 0.5, 0.0, image.shape[axis] - 1.0)
        low = np.minimum(place.astype(np.int64), max(image.shape[axis] - 2, 0))
        share = (place - low).astype(np.float32).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
        high = np.minimum(low + 1, image.shape[axis] - 1)
        image = np.take(image, low, axis) * (1 - share) + np.take(image, high, axis) * share
    return image
