"""`--method paper`, the method of FlexGaussian: score, rank, search over prune rate and SH rate, write, measure.

It takes less time than `best` and makes larger files.
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass

import numpy as np

from flexgs_edge.codec.v1.container import write_container
from flexgs_edge.codec.v1.packed_source import FgsSource
from flexgs_edge.files import temporary_name
from flexgs_edge.goals.steps import SearchResult, Step, step_words
from flexgs_edge.methods.paper.evaluator import Ranked, SceneEvaluator
from flexgs_edge.methods.paper.prune import nonzero_sh, order_from_scores
from flexgs_edge.methods.paper.scores import score_cache, score_scene
from flexgs_edge.methods.paper.search import adapt, measure_fixed
from flexgs_edge.packed.quantize import QuantizedScene, quantized_bytes
from flexgs_edge.progress import LOG
from flexgs_edge.quality.view_quality import Quality
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.run.decoding import decode_bytes, read_often
from flexgs_edge.run.evaluators import Evaluators
from flexgs_edge.run.foresight import drawing_bytes
from flexgs_edge.run.method_result import MethodResult
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.outputs import check_smaller
from flexgs_edge.run.run import Run
from flexgs_edge.run.settings import make_settings
from flexgs_edge.units import format_size

RANK_ROW_BYTES = 36
"""Bytes a Gaussian of orders, ranks, numbers of rows with SH, and rows of one choice. Scores, made before, take less."""


@dataclass(frozen=True)
class Ranking:
    """The order in which rows are pruned."""

    order: np.ndarray  # [N] i64, rows of the scene, least important first
    reused: bool = False  # whether their scores came from the cache


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
        ranking = _rank(run, judges, renderer)
        with run.clock.stage("open"):
            has_sh = nonzero_sh(run.source)
        bits, groups = run.options.bit_spec()
        ranked = Ranked(run.source, ranking.order, has_sh)
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
            bits=quantized.bits,
            groups={name: array.groups for name, array in quantized.arrays.items()},
            scores_reused=ranking.reused,
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


def _rank(run: Run[CompressOptions], judges: Evaluators | None, renderer: Renderer | None) -> Ranking:
    """Draw the references, and score every Gaussian unless the cache has the scores."""
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
    return Ranking(order, reused)


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
