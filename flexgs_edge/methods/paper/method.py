"""`--method paper`, the method of FlexGaussian: score, rank, search over prune rate and SH rate, write, measure.

It takes less time than `best` and makes larger files. Scores are those of FlexGaussian (`gs`) or MesonGS (`meson`).
"""

import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.codec.v1.container import container_size, write_container
from flexgs_edge.codec.v1.packed_source import FgsSource
from flexgs_edge.constants import VOLUME_POWER
from flexgs_edge.errors import InputError
from flexgs_edge.files import atomic_write, temporary_name
from flexgs_edge.goals.steps import Choice, SearchResult, Step, step_words
from flexgs_edge.goals.target import Measurement
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.methods.paper.prune import nonzero_sh, order_from_scores, ranks_from_order, select_rows
from flexgs_edge.methods.paper.search import adapt, measure_fixed
from flexgs_edge.packed.bitpack import BitSpec
from flexgs_edge.packed.quantize import QuantizedScene, far_contraction, quantize_scene, quantized_bytes
from flexgs_edge.progress import LOG, SILENT, Progress
from flexgs_edge.quality.view_quality import Quality
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.render.statistics import Statistics
from flexgs_edge.run.decoding import decode_bytes, read_often
from flexgs_edge.run.evaluators import Evaluators
from flexgs_edge.run.fingerprint import fingerprint
from flexgs_edge.run.method_result import MethodResult, make_settings
from flexgs_edge.run.open_renderer import drawing_bytes
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.quality_evaluator import QualityEvaluator, measurement_of
from flexgs_edge.run.run import Run, check_smaller
from flexgs_edge.scene.source import SceneSource
from flexgs_edge.units import format_size

RANK_ROW_BYTES = 36
"""Bytes a Gaussian of orders, ranks, numbers of rows with SH, and rows of one choice. Scores, made before, take less."""
QUANTIZE_COPIES = 4  # Copies of a chunk's planes that quantizing holds at once: as read, gathered, and codes in between
ROWS = 1 << 16  # Rows of the scene read at a time


def score_scene(
    renderer: Renderer,  # draws the views
    scene: DeviceScene,  # loaded from `source`
    source: SceneSource,  # read again for opacities and volumes, `ROWS` rows at a time
    cameras: Sequence[Camera],  # the training poses
    kind: str = "gs",
    progress: Progress = SILENT,  # told of each view
) -> np.ndarray:
    """Log of the importance of every Gaussian. Only the order matters, and a log cannot underflow for tiny volumes.

    `kind` ({"gs", "meson"}): `gs`: opacity * volume^0.1 * hits (LightGaussian, FlexGaussian). `meson`: volume^0.1 *
    sum(alpha T) (MesonGS). Default: `gs`. Returns [N] f64; -inf for Gaussians that no pose sees. Raises `InputError`
    when no camera sees any Gaussian.
    """
    statistics = Statistics.zeros(scene.count)
    for camera in progress.track(cameras, "scoring views", len(cameras)):
        renderer.add_statistics(scene, camera, statistics)
    if not statistics.hits.any():
        raise InputError(
            f"none of the {len(cameras)} cameras sees any of the {scene.count} Gaussians: do scene and cameras belong together, "
            "and is the near plane (--near) in front of the scene?"
        )
    scores = np.empty(source.count)
    for rows in source.chunks(ROWS):
        part = source.read(rows, ["log_scales", "opacity_logits"])
        seen = Statistics(statistics.hits[rows], statistics.weights[rows])
        scores[rows] = VOLUME_POWER * part["log_scales"].sum(axis=0, dtype=np.float64)
        if kind == "gs":
            scores[rows] -= np.logaddexp(0.0, -part["opacity_logits"][0].astype(np.float64))
        with np.errstate(divide="ignore"):  # unseen Gaussians get log(0) = -inf
            scores[rows] += np.log(seen.hits.astype(np.float64) if kind == "gs" else seen.weight_sums)
    return scores


class ScoreCache:
    """A file with the scores of one scene seen from one set of poses.

    `path`: made by `save`. It need not exist. `fingerprint`: of the scene, poses and kind of score.
    """

    def __init__(self, path: str | Path, fingerprint: str) -> None:
        self.path, self.fingerprint = Path(path), fingerprint

    def load(self, count: int) -> np.ndarray | None:
        """[count] f64, or `None` if there is no file yet or its fingerprint differs.

        Raises `InputError` when `save` did not write the file, because the run would overwrite it.
        """
        try:
            with open(self.path, "rb") as file, np.load(file, allow_pickle=False) as archive:
                key, scores = str(archive["fingerprint"]), archive["scores"]
        except FileNotFoundError:
            return None
        except (OSError, ValueError, EOFError, KeyError, TypeError, zipfile.BadZipFile, zlib.error) as error:
            raise InputError(
                f"{self.path}: expected scores kept by score or by an earlier --score-cache, found something else ({error}); "
                "remove the file, or name another one"
            ) from error
        same = key == self.fingerprint and scores.shape == (count,) and scores.dtype == np.float64
        return scores if same else None

    def save(self, scores: np.ndarray) -> None:
        """Write the scores ([N] f64); an old file is replaced."""
        with atomic_write(self.path, force=True) as file:
            np.savez(file, fingerprint=np.array(self.fingerprint), scores=scores)


def score_cache(path: str | Path, run: Run[Any], score: str) -> ScoreCache:
    """The cache at `path`, with the fingerprint of a run and the kind of its scores."""
    options = run.options
    assert options.near is not None
    cameras = run.seen.of(run.seen.train)
    return ScoreCache(path, fingerprint(run.source, cameras, score, options.near, bool(options.antialiased)))


@dataclass(frozen=True)
class Ranked:
    """A scene and the order in which its rows are pruned."""

    source: SceneSource  # the original
    order: np.ndarray  # [N] i64, least important row first
    has_sh: np.ndarray  # [N] bool, rows with SH that are not zero


class SceneEvaluator:
    """Prunes by rank, quantizes, and asks the judge; see `flexgs_edge.goals.Evaluator`.

    `ranked`: the scene. `bits`: bits per code. `groups`: as for `quantize_scene`. `judge`: draws and compares. Without
    one, `measure` and `estimate` fail. `budget`: the quantized scene is taken from it.
    """

    def __init__(
        self, ranked: Ranked, bits: BitSpec, groups: int | None, judge: QualityEvaluator | None, budget: MemoryBudget
    ) -> None:
        self.source = ranked.source
        self.bits = bits
        self.groups = groups
        self.judge = judge
        self.budget = budget
        self._ranks = ranks_from_order(ranked.order)
        self._contraction = far_contraction(self.source)
        self._has_sh = ranked.has_sh
        # Number of SH rows from each rank up. With it sizes cost nothing, and the search asks for hundreds of sizes.
        self._sh_above = np.concatenate([np.cumsum(ranked.has_sh[ranked.order][::-1])[::-1], [0]])

    def counts(self, choice: Choice) -> tuple[int, int]:
        """Number of rows that stay, and number of these that keep SH."""
        kept = self.source.count - choice.pruned(self.source.count)
        return kept, int(self._sh_above[choice.boundary(self.source.count)])

    def size(self, choice: Choice) -> int:
        """Exact bytes of the file."""
        kept, with_sh = self.counts(choice)
        return container_size(kept, with_sh, self.source.sh_degree, self.bits, self.groups)

    def measure(self, choice: Choice) -> Measurement:
        """Prune, quantize, dequantize, render and compare."""
        assert self.judge is not None
        with self.quantized(choice) as quantized, self.judge.renderer.load_quantized(quantized) as scene:
            return measurement_of(self.judge.compare(scene, with_ssim=True))

    def estimate(self, choice: Choice) -> Measurement:
        """As `measure`, from a fourth of the pixels."""
        assert self.judge is not None
        with self.quantized(choice) as quantized, self.judge.renderer.load_quantized(quantized) as scene:
            return measurement_of(self.judge.estimate(scene))

    @contextmanager
    def quantized(self, choice: Choice) -> Iterator[QuantizedScene]:
        """The quantized scene of a choice; its bytes are taken from the budget while the block lasts."""
        kept, with_sh = self.counts(choice)
        size = quantized_bytes(kept, with_sh, self.source.sh_degree if with_sh else 0, self.bits, self.groups)
        self.budget.take("the quantized scene", size)
        try:
            per_row = QUANTIZE_COPIES * 4 * (14 + self.source.width("sh_rest"))
            chunk_rows = self.budget.rows("quantizing", per_row, minimum=min(kept, 1024), most=65536)
            rows = select_rows(self._ranks, choice, self._has_sh)
            yield quantize_scene(self.source, *rows, self.bits, self.groups, chunk_rows, self._contraction)
        finally:
            self.budget.give(size)


def compress(run: Run[CompressOptions], renderer: Renderer | None) -> MethodResult:
    """Compress a scene into a `.fgs` of version 1.

    `run`: planned. `renderer`: draws the views; `None` for runs without views, whose rates are fixed.
    """
    if renderer is not None:
        with run.clock.stage("open"):  # the search reads the scene for every choice that it measures
            source = read_often(run.source, run.budget, searching_bytes(run), renderer.backend)
            run = run.of_source(source)
    run.budget.take("the order of the Gaussians", RANK_ROW_BYTES * run.source.count)
    with nullcontext() if renderer is None else Evaluators(run, renderer) as judges:
        order, reused = _rank(run, judges, renderer)
        with run.clock.stage("open"):
            has_sh = nonzero_sh(run.source)
        bits, groups = run.options.bit_spec()
        ranked = Ranked(run.source, order, has_sh)
        evaluator = SceneEvaluator(ranked, bits, groups, None if judges is None else judges.decide, run.budget)
        with run.clock.stage("search"):
            search = _search(run, evaluator)
        if judges is not None:
            judges.decided()
        choice = search.chosen.choice if search else run.options.fixed
        assert choice is not None
        with evaluator.quantized(choice) as quantized:
            quality = _write(run, quantized, search, judges)
        return MethodResult(
            size=evaluator.size(choice),
            count=quantized.count,
            sh_count=quantized.sh_count,
            sh_degree=quantized.sh_degree,
            choice=choice,
            search=search,
            quality=quality,
            trained=None if judges is None else judges.trained,
            lost=() if judges is None else judges.lost,
            bits=quantized.bits,
            groups={name: array.groups for name, array in quantized.arrays.items()},
            scores_reused=reused,
        )


def expected_bytes(run: Run[CompressOptions]) -> int:
    """Bytes that the search is expected to need, and reading the scene beside it."""
    return searching_bytes(run) + decode_bytes(run.source, None)


def searching_bytes(run: Run[CompressOptions]) -> int:
    """Bytes of ranks, of a view, and of the codes of all rows, up to twice as large on the device."""
    source, (bits, groups) = run.source, run.options.bit_spec()
    return (
        RANK_ROW_BYTES * source.count
        + drawing_bytes(run)
        + 3 * quantized_bytes(source.count, source.count, source.sh_degree, bits, groups)
    )


def _rank(run: Run[CompressOptions], judges: Evaluators | None, renderer: Renderer | None) -> tuple[np.ndarray, bool]:
    """Draw the references, and score every Gaussian unless the cache has the scores.

    Returns the order in which rows are pruned ([N] i64), and whether the scores came from the cache.
    """
    assert run.plan is not None
    scores, reused, cache = None, False, None
    if run.plan.needs_scores and run.options.score_cache is not None:
        with run.clock.stage("fingerprint"):
            cache = score_cache(run.options.score_cache, run, run.options.score)
    if cache is not None:
        scores = cache.load(run.source.count)
        reused = scores is not None
        LOG.info("scores %s %s", "reused from" if reused else "will be kept in", cache.path)
    if judges is not None and renderer is not None:
        with judges.original() as original:
            if run.plan.needs_scores and scores is None:
                cameras = run.seen.of(run.seen.train)
                LOG.info("scoring %d Gaussians over %d training poses", run.source.count, len(cameras))
                with run.clock.stage("score"):
                    scores = score_scene(renderer, original, run.source, cameras, run.options.score, run.progress)
    if cache is not None and scores is not None and not reused:
        cache.save(scores)
    order = np.arange(run.source.count) if scores is None else order_from_scores(scores)
    return order, reused


def _search(run: Run[CompressOptions], evaluator: SceneEvaluator) -> SearchResult | None:
    if evaluator.judge is None:
        return None
    if run.options.fixed is not None:
        return measure_fixed(evaluator, run.options.fixed)
    target, options = run.target, run.options
    LOG.info("searching for %s", target.describe())

    def said(step: Step) -> None:
        LOG.info("%s", step_words(step, target))

    return adapt(evaluator, target, options.effort, options.takes_closest, said, run.source.count)


def _write(
    run: Run[CompressOptions], quantized: QuantizedScene, search: SearchResult | None, judges: Evaluators | None
) -> Quality | None:
    """Write the file under a temporary name, measure the decoded scene, and only then give the file its name."""
    settings, output = make_settings(run, search, quantized.bits), run.output.path
    if output is None:
        if run.reporter is not None:
            run.reporter.read_contents_of(lambda place: write_container(place, quantized, settings))
        return None if judges is None else judges.measure_quantized(quantized)
    with temporary_name(output, run.options.force) as place:
        with run.clock.stage("write"):
            size = write_container(place, quantized, settings)
        check_smaller(size, run.scene.file_bytes, run.options)
        quality = None
        if judges is not None:
            run.budget.take("the decoded file", size)
            quality = judges.measure_quantized(FgsSource(place).quantized())
            run.budget.give(size)
    LOG.info("wrote %s, %s", output, format_size(size))
    return quality
