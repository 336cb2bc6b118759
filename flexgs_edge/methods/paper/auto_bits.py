"""`--bits auto`: finds bits for each attribute by the paper's sensitivity search on the scene itself."""

from __future__ import annotations

import logging

from flexgs_edge.methods.paper.evaluator import SceneEvaluator
from flexgs_edge.packed.bitspec import BitSpec
from flexgs_edge.packed.sensitivity import ALLOWED_DROP, Sensitivity, search_bits
from flexgs_edge.quality.psnr import error_for_drop
from flexgs_edge.run.judge import Judge
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.plan import EVERYTHING
from flexgs_edge.run.run import Run
from flexgs_edge.views.bench import Bench

LOG = logging.getLogger("flexgs_edge")

SENSITIVITY_VIEWS = 8
"""Most training poses that sensitivity is measured on, evenly spread."""


def bits_by_sensitivity(
    evaluator: SceneEvaluator, run: Run[CompressOptions], bench: Bench
) -> tuple[BitSpec, list[Sensitivity]]:
    """Search for the bits with nothing pruned; returns them and the measured sensitivities."""
    renderer, source, views, base_psnr = bench.renderer, evaluator.source, run.seen, run.options.base_psnr
    count = min(SENSITIVITY_VIEWS, len(views.train))
    indices = [views.train[i * len(views.train) // count] for i in range(count)]
    judge = Judge(bench, source, views, indices, with_photos=False, base_psnr=base_psnr)
    with renderer.load(source) as original:
        judge.prepare(original, run.progress)

    def error(bits: BitSpec) -> float:
        with evaluator.quantized(EVERYTHING, bits) as quantized, renderer.load_quantized(quantized) as scene:
            return judge.compare(scene).deciding_error

    kept, with_sh = evaluator.counts(EVERYTHING)
    bits, found = search_bits(error, source.sh_degree, with_sh / kept, error_for_drop(ALLOWED_DROP, judge.base_psnr))
    judge.close()
    LOG.info("bits found by sensitivity: %s", bits)
    return bits, found
