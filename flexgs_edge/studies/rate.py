"""`study rate`: bytes against quality of both methods, and of the whole scene in the formats of other programs."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge.commands.compress import compress
from flexgs_edge.commands.decompress import decompress
from flexgs_edge.commands.evaluate import evaluate
from flexgs_edge.errors import InputError
from flexgs_edge.io.formats import FORMATS
from flexgs_edge.progress import LOG, SILENT, Progress
from flexgs_edge.quality.view_quality import Quality
from flexgs_edge.report.as_json import rounded
from flexgs_edge.report.plots import LineChart, Series
from flexgs_edge.report.results import CompressResult
from flexgs_edge.run.inputs import load_scene
from flexgs_edge.run.options import NO_CAMERAS, CompressOptions
from flexgs_edge.run.quality_evaluator import measurement_of
from flexgs_edge.studies import written

RATIOS = (8.0, 16.0, 32.0, 64.0, 128.0, 256.0)
PEERS = (".spz", ".sog", ".compressed.ply")  # Formats of other programs that the study compares with
LEAST_LOSS = 0.001
"""Points with less loss than this, in dB, are left out. Loss and bytes are interpolated on log scales, because such curves are
nearly power laws."""
SLACK = 1e-9  # Tolerance, so that the curve's own points lie on it in spite of rounding
FIDELITY_WORDS = "fidelity: PSNR against the original's renders"
HEADS = {
    "method": "method",
    "wanted_ratio": "ratio wanted",
    "kept": "Gaussians kept",
    "bits": "bits a Gaussian kept",
    "psnr": "PSNR (dB)",
    "ssim": "SSIM",
    "flip": "FLIP",
    **written.FIGURES,
    "seconds": "seconds",
}
_INTRO = (
    "Bytes and quality of a scene compressed by flexgs-edge to many sizes, beside the paper's method and the formats of other "
    "programs. Sizes are bytes of the finished file. Ratios are to the PLY as INRIA writes it. All methods are judged by the "
    "same renderer over the same views."
)


def study_rate(
    scene: str | Path,
    output: str | Path,
    options: CompressOptions | None = None,
    progress: Progress = SILENT,
    ratios: Sequence[float] = RATIOS,
    **words: Any,
) -> written.Study:
    """Measure bytes and quality of every method on a scene and write them to a folder.

    `ratios`: PLY bytes over file bytes.
    """
    options = replace(options or CompressOptions(), **words)
    bad = [value for value in ratios if not (math.isfinite(value) and value >= 1.0)]
    if bad:
        raise InputError(f"--ratios {bad[0]:g}: expected ratios of 1 or more, such as 8,16,32")
    if not ratios:
        raise InputError("--ratios: expected one ratio or more, such as 8,16,32")
    points = _Points(scene, options, progress)
    return written.write_study(
        "study rate",
        output,
        options.force,
        "Bytes and quality",
        _INTRO,
        lambda folder: points.study(sorted(set(ratios)), folder),
    )


@dataclass
class _Points:
    """Files of one scene, made as a user would make them, and what they keep."""

    scene: str | Path
    options: CompressOptions
    progress: Progress

    def __post_init__(self) -> None:
        # Methods are compared by the mean alone, each at the size that it is given.
        self.options = replace(self.options, promise="mean", dry_run=True, report=None)
        self.rows: list[dict[str, written.Cell]] = []
        self.missing: list[str] = []

    def study(self, ratios: Sequence[float], folder: Path) -> written.SceneStudy:
        """Make all files, and compare them."""
        unpruned = self._compress("paper", None, prune_rate=0.0, sh_rate=0.0)
        for ratio in ratios:
            self._compress("best", ratio)
        for ratio in ratios:
            # At most so much the bits alone reach: the point with nothing pruned covers it.
            if ratio > unpruned.ratio:
                self._compress("paper", ratio, score_cache=str(folder / "scores.npz"))
        for suffix in PEERS:
            self._convert(folder / f"scene{suffix}", unpruned)
        order = ("best", "paper")
        self.rows.sort(key=lambda row: order.index(str(row["method"])) if row["method"] in order else len(order))
        table = written.Table(HEADS, tuple(self.rows))
        made = [_rate(table, self.missing, self.options.effort)]
        if table.rows[-1]["drop"] is not None:
            made.append(_fidelity(table))
        return written.SceneStudy.of(self.scene, unpruned, *made)

    def _compress(self, method: str, ratio: float | None, **words: Any) -> CompressResult:
        options = replace(self.options, method=method, min_ratio=ratio, **words)
        found = compress(self.scene, None, replace(options, best_effort=True), self.progress)
        name = method if ratio is None else f"{method} at {ratio:g}x"
        if found.reached is False:
            self.missing.append(name)
        else:
            assert found.quality is not None
            seconds = found.run.seconds - found.run.startup_seconds
            self._add(method, ratio, found.size, found.count, found.scene.ply_bytes, found.quality, seconds)
        return found

    def _convert(self, place: Path, of: CompressResult) -> None:
        """The whole scene in another program's format."""
        word, options = FORMATS[place.name.removeprefix("scene")].word, self.options
        try:
            scene = load_scene(self.scene, options.drop_invalid, options.reading)
            limits: dict[str, Any] = {"memory_limit": options.memory_limit, "device": options.device}
            made = decompress(scene, place, cameras=NO_CAMERAS, **limits)
        except InputError as error:  # the format cannot hold this scene
            LOG.warning("%s left out: %s", word, error)
            self.missing.append(f"{word} ({error})")
            return
        found = evaluate(place, self.scene, options, options.base_psnr, self.progress)
        self._add(word, None, made.size, found.scene.count, of.scene.ply_bytes, found.quality, made.run.seconds)

    def _add(
        self, method: str, ratio: float | None, size: int, kept: int, ply_bytes: int, quality: Quality, seconds: float
    ) -> None:
        ssim = quality.ssim_original if quality.ssim_photo is None else quality.ssim_photo
        flip = quality.flip_original if quality.flip_photo is None else quality.flip_photo
        self.rows.append(
            {
                "method": method,
                "wanted_ratio": ratio,
                "kept": kept,
                "bits": round(8 * size / kept, 2),
                "psnr": rounded(quality.psnr),
                "ssim": rounded(ssim, 5),
                "flip": rounded(flip, 5),
                **written.figures(size, ply_bytes, measurement_of(quality)),
                "seconds": round(seconds, 2),
            }
        )


class Curve:
    """Bytes and loss of one method at several sizes. `points`: bytes and dB."""

    def __init__(self, points: Iterable[tuple[float, float]]) -> None:
        known = sorted((size, loss) for size, loss in points if loss >= LEAST_LOSS)
        self._sizes = np.log([size for size, _ in known])
        # With noise a smaller file may be the better one. The smaller file then counts.
        self._losses = np.minimum.accumulate(np.log([loss for _, loss in known]))

    def size(self, loss: float) -> float | None:
        """Fewest bytes at `loss` dB; None beyond the curve's ends."""
        place = float(np.log(max(loss, 1e-12)))
        if not len(self._sizes) or not self._losses[-1] - SLACK <= place <= self._losses[0] + SLACK:
            return None
        after = int(np.flatnonzero(self._losses <= place + SLACK)[0])
        if after == 0:
            return float(np.exp(self._sizes[0]))
        ends = slice(after - 1, after + 1)
        return float(np.exp(np.interp(-place, -self._losses[ends], self._sizes[ends])))


def _rate(table: written.Table, missing: Sequence[str], effort: str) -> written.Experiment:
    """Compare all methods by bytes and the deciding figure."""
    with_photos = table.rows[-1]["drop"] is not None
    against = "PSNR, SSIM and FLIP are against the photos"
    if not with_photos:
        against = "SSIM and FLIP are against the original: there are no photos"
    findings = list(_comparisons(table.rows, "drop" if with_photos else "modelled_drop"))
    if missing:
        findings.append(f"Left out or not reached: {'; '.join(missing)}.")
    return written.Experiment(
        "rate",
        "Bytes and quality",
        f"Every method at the sizes asked for: best at the effort {effort}, paper with its rates to choose, and the whole scene "
        f"in the formats of other programs as this one writes them. {against}; {FIDELITY_WORDS}.",
        table,
        _chart(table, "Bytes and quality", "drop" if with_photos else "fidelity"),
        tuple(findings),
        timed=True,
    )


def _fidelity(table: written.Table) -> written.Experiment:
    """Compare all methods by bytes and fidelity to the original's renders, for scenes that photos decide."""
    names = ("method", "wanted_ratio", "size", "ratio", "fidelity")
    rows = tuple({name: row[name] for name in names} for row in table.rows)
    own = written.Table({name: HEADS[name] for name in names}, rows)
    best = [row for row in own.rows if row["method"] == "best"]
    return written.Experiment(
        "fidelity",
        "Bytes and fidelity",
        f"The same files; {FIDELITY_WORDS}, which shows all errors. A drop against photos hides those that come nearer to one.",
        own,
        _chart(own, "Bytes and fidelity", "fidelity"),
        ("Fidelity of best: " + ", ".join(f"{row['fidelity']:.1f} dB at {row['ratio']:.0f}x" for row in best) + ".",),
    )


def _chart(table: written.Table, title: str, figure: str) -> LineChart:
    series = []
    for method in dict.fromkeys(str(row["method"]) for row in table.rows):
        sizes = [size / 1e6 for size in table.values("size", method=method)]
        wanted = table.values("wanted_ratio", method=method)
        notes = {"best": [f"{ratio:g}x" for ratio in wanted if ratio], "paper": [""] * len(sizes)}.get(method)
        series.append(Series(method, sizes, table.values(figure, method=method), notes=notes or [method]))
    floating = figure == "fidelity"
    words = "bytes of the file, MB (log)"
    return LineChart(
        title, words, written.FIGURES[figure], tuple(series), log_x=True, floating=floating, magnitudes=not floating
    )


def _comparisons(rows: Sequence[written.Row], figure: str) -> Iterator[str]:
    """Sentences that compare best with each other method, at equal loss."""
    word = written.FIGURES[figure].removesuffix(" (dB)")
    best = [row for row in rows if row["method"] == "best"]
    paper = {row["wanted_ratio"]: row for row in rows if row["method"] == "paper" and row["wanted_ratio"] is not None}
    pairs = [(row, paper[row["wanted_ratio"]]) for row in best if row["wanted_ratio"] in paper]
    if pairs:
        words = ", ".join(
            f"{a['wanted_ratio']:g}x: {written.number(a, figure):.2f} / {written.number(b, figure):.2f} dB"
            for a, b in pairs
        )
        yield f"{word.capitalize()} of best / paper at equal ratios: {words}."
    curve = Curve((written.number(row, "size"), written.number(row, figure)) for row in best)

    def share(row: written.Row) -> float | None:
        """Bytes on the curve of best at the row's loss, divided by the row's bytes."""
        size = curve.size(written.number(row, figure))
        return None if size is None else size / written.number(row, "size")

    shares = [part for part in map(share, paper.values()) if part is not None]
    if shares:
        yield (
            f"At equal {word} best needs {min(shares):.0%} to {max(shares):.0%} of paper's bytes "
            f"({len(shares)} of paper's {len(paper)} points lie on its curve)."
        )
    for row in rows:
        if row["method"] not in ("best", "paper"):
            part = share(row)
            than = "beyond the ends of best's curve" if part is None else f"best needs {part:.0%} of its bytes there"
            yield f"{row['method']}: {row['ratio']:.1f}x at {written.number(row, figure):.3f} dB of {word}; {than}."
