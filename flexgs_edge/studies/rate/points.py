"""Makes files of a scene by each method at the wanted sizes, and measures all of them alike."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

from flexgs_edge.errors import InputError
from flexgs_edge.goals.steps import Choice
from flexgs_edge.goals.target import MaxSize, min_ratio
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.grid.values import from_grid
from flexgs_edge.io.exchange import near_order
from flexgs_edge.io.formats import FORMATS, Format
from flexgs_edge.methods.best.grid_coder import GridCoder
from flexgs_edge.methods.best.method import grid_maker, open_rounds, search_rounds
from flexgs_edge.methods.best.poses import scored_poses
from flexgs_edge.methods.foreign.file_maker import open_files
from flexgs_edge.quality.view_quality import Quality
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.run.outputs import Output
from flexgs_edge.run.plan import EVERYTHING
from flexgs_edge.run.quality_evaluator import measurement_of
from flexgs_edge.run.settings import make_settings, settings_room
from flexgs_edge.scene.source import MemorySource
from flexgs_edge.studies.result_tables import Cell, Column, columns
from flexgs_edge.studies.study_scene import FIGURES, Setting, StudyScene
from flexgs_edge.units import format_size

LOG = logging.getLogger("flexgs_edge")

WHOLE, UNPRUNED = "whole", "nothing pruned"


@dataclass(frozen=True)
class RatePoint:
    """A file and its quality."""

    method: str  # `best`, `paper`, or the format of another program
    variant: str  # `whole`, or what was left out
    effort: str | None  # effort of the search, if there was one
    wanted: float | None  # the ratio that was asked for
    size: int  # bytes of the file
    kept: int  # Gaussians in the file
    quality: Quality  # over the views that decide, with SSIM and FLIP
    seconds: float | None  # time of the search or conversion, without measuring the final quality

    @property
    def ssim(self) -> float | None:
        """SSIM against the photos if there are any, else against the original's renders."""
        return self.quality.ssim_original if self.quality.ssim_photo is None else self.quality.ssim_photo

    @property
    def flip(self) -> float | None:
        """FLIP against the same."""
        return self.quality.flip_original if self.quality.flip_photo is None else self.quality.flip_photo


PEERS = (".spz", ".sog", ".compressed.ply")  # Formats of other programs that the study compares with


@dataclass(frozen=True)
class Found:
    """Points, and sentences about those that could not be made."""

    points: tuple[RatePoint, ...]
    missing: tuple[str, ...] = ()

    def __add__(self, other: Found) -> Found:
        return Found(self.points + other.points, self.missing + other.missing)


NOTHING = Found(())


def point_columns() -> tuple[Column, ...]:
    """Columns of a table of points."""
    return columns(
        method="method",
        variant="variant",
        effort="effort",
        wanted_ratio="ratio wanted",
        kept="Gaussians kept",
        bits="bits a Gaussian kept",
        psnr="PSNR (dB)",
        ssim="SSIM",
        flip="FLIP",
        **FIGURES,
        seconds="seconds",
    )


def point_row(studied: StudyScene, point: RatePoint) -> dict[str, Cell]:
    """The cells of a point."""
    quality = point.quality
    return {
        "method": point.method,
        "variant": point.variant,
        "effort": point.effort,
        "wanted_ratio": point.wanted,
        "kept": point.kept,
        "bits": round(8 * point.size / point.kept, 2),
        "psnr": None if quality.psnr is None else round(quality.psnr, 4),
        "ssim": None if point.ssim is None else round(point.ssim, 5),
        "flip": None if point.flip is None else round(point.flip, 5),
        **studied.figures(point.size, measurement_of(quality)),
        "seconds": None if point.seconds is None else round(point.seconds, 2),
    }


def loss_of(studied: StudyScene, point: RatePoint) -> float:
    """The loss of a point in the figure that decides, dB."""
    return measurement_of(point.quality).loss(studied.plan.figure)


def paper_points(studied: StudyScene, ratios: Sequence[float]) -> Found:
    """Points of `--method paper`: one with nothing pruned, and the best quality that its search finds in each size."""
    found = Found((_paper_point(studied, None, EVERYTHING, 0.0),))
    least = studied.size(Setting(EVERYTHING))
    for ratio in ratios:
        started = time.perf_counter()
        target = _target(studied, ratio)
        if least <= target.limit_bytes:
            continue  # nothing has to be pruned for this size: the first point covers it
        search = studied.adapt(target)
        if search.reached:
            point = _paper_point(studied, ratio, search.chosen.choice, time.perf_counter() - started)
            found += Found((point,))
        else:
            found += Found((), (f"paper at {ratio:g}x",))
    return found


def _paper_point(studied: StudyScene, ratio: float | None, choice: Choice, seconds: float) -> RatePoint:
    evaluator = studied.evaluator(Setting(choice))
    with evaluator.quantized(choice) as quantized, studied.context.renderer.load_quantized(quantized) as scene:
        quality = _judged(studied, scene)
    kept, _ = evaluator.counts(choice)
    variant = WHOLE if ratio is not None else UNPRUNED
    effort = None if ratio is None else studied.run.options.effort
    return _said(RatePoint("paper", variant, effort, ratio, evaluator.size(choice), kept, quality, seconds))


def best_points(studied: StudyScene, effort: str, ratios: Sequence[float]) -> Found:
    """Points of `--method best`. All ratios share their rounds, the weakest compression first."""
    run, source = studied.run, studied.run.source
    options = replace(studied.run.options, effort=effort, best_effort=True)
    # All sizes share their rounds, and so their poses: those of the largest size.
    largest = replace(
        options, max_drop=None, min_fidelity=None, max_size=None, min_ratio=min(ratios), max_worst_drop=None
    )
    cameras, covered = studied.views.of(studied.views.train), studied.judge.covered_decides
    poses = scored_poses(cameras, largest, studied.context.renderer, source, covered)
    found = NOTHING
    started = time.perf_counter()
    run = replace(run, options=options)
    with open_rounds(run, studied.context, poses.cameras, known=poses.known) as rounds:
        for ratio in sorted(ratios):
            aimed = run.aimed_at(_target(studied, ratio))
            coder = GridCoder(studied.context.renderer, settings_room(aimed))
            make = grid_maker(options, coder)
            with run.clock.stage("search"):
                grid, search = search_rounds(make, rounds, aimed, studied.judge)
            seconds = time.perf_counter() - started
            if search.reached:
                size = coder.size(grid, make_settings(aimed, search))
                quality = _judged_source(studied, grid)
                point = RatePoint("best", WHOLE, effort, ratio, size, grid.count, quality, seconds)
                found += Found((_said(point),))
            else:
                found += Found((), (f"best ({effort}) at {ratio:g}x",))
            started = time.perf_counter()
    return found


def peer_points(studied: StudyScene, folder: Path) -> Found:
    """Points of the whole scene, unpruned, in the formats of other programs."""
    found = NOTHING
    for suffix in PEERS:
        format = FORMATS[suffix]
        name = format.word
        try:
            found += Found((_said(_peer_point(studied, name, format, folder / f"scene{suffix}")),))
        except InputError as error:  # the format cannot hold this scene
            LOG.warning("%s left out: %s", name, error)
            found += Found((), (f"{name} ({error})",))
    return found


def _peer_point(studied: StudyScene, name: str, format: Format, place: Path) -> RatePoint:
    source = studied.run.source
    with ExitStack() as stack:
        files = stack.enter_context(open_files(replace(studied.run, output=Output(place, format)), format))
        started = time.perf_counter()
        # Rows in the order that `compress` writes: neighbours along the curve have similar bytes.
        path, decoded = files.write(source.select(near_order(source)))
        seconds = time.perf_counter() - started
        with studied.context.renderer.load(decoded) as scene:
            quality = _judged(studied, scene)
        return RatePoint(name, WHOLE, None, None, path.stat().st_size, decoded.count, quality, seconds)


def _target(studied: StudyScene, ratio: float) -> MaxSize:
    return min_ratio(ratio, studied.run.scene.ply_bytes, studied.plan.figure)


def _judged_source(studied: StudyScene, grid: GridScene) -> Quality:
    with studied.context.renderer.load(MemorySource(from_grid(grid), origin=grid.origin)) as scene:
        return _judged(studied, scene)


def _judged(studied: StudyScene, scene: DeviceScene) -> Quality:
    with studied.run.clock.stage("measure"):
        return studied.judge.compare(scene, with_ssim=True, progress=studied.run.progress, flip=True)


def _said(point: RatePoint) -> RatePoint:
    wanted = "" if point.wanted is None else f" at {point.wanted:g}x"
    found = measurement_of(point.quality)
    loss = f"modelled drop {found.modelled_drop:.3f}" if found.drop is None else f"drop {found.drop:.3f}"
    LOG.info(
        "%s, %s%s: %s, %s dB, %.1f s",
        point.method, point.variant, wanted, format_size(point.size), loss, point.seconds or 0.0,
    )  # fmt: skip
    return point
