"""`--bits auto`: the paper's sensitivity search on a real scene."""

from __future__ import annotations

import logging

from flexgs_edge.methods.paper.evaluator import SceneEvaluator
from flexgs_edge.packed.bitspec import BitSpec
from flexgs_edge.packed.sensitivity import ALLOWED_DROP, Sensitivity, search_bits
from flexgs_edge.progress import Progress
from flexgs_edge.quality.psnr import error_for_drop
from flexgs_edge.run.judge import Judge
from flexgs_edge.run.plan import EVERYTHING
from flexgs_edge.run.view_set import ViewSet

LOG = logging.getLogger("flexgs_edge")

SENSITIVITY_VIEWS = 8
"""Training poses that it measures on, evenly spread."""


def bits_by_sensitivity(
    evaluator: SceneEvaluator, views: ViewSet | None, base_psnr: float, progress: Progress
) -> tuple[BitSpec, list[Sensitivity]]:
    """The bits, and what was measured, with nothing pruned."""
    renderer, source = evaluator.renderer, evaluator.source
    assert renderer is not None and views is not None
    count = min(SENSITIVITY_VIEWS, len(views.train))
    indices = [views.train[i * len(views.train) // count] for i in range(count)]
    judge = Judge(renderer, source, views, indices, evaluator.budget, False, base_psnr)
    with renderer.load(source) as original:
        judge.prepare(original, progress)

    def error(bits: BitSpec) -> float:
        with evaluator.quantized(EVERYTHING, bits) as quantized, renderer.load_quantized(quantized) as scene:
            return judge.compare(scene).error

    kept, with_sh = evaluator.counts(EVERYTHING)
    bits, found = search_bits(error, source.sh_degree, with_sh / kept, error_for_drop(ALLOWED_DROP, base_psnr))
    judge.close()
    LOG.info("bits found by sensitivity: %s", bits)
    return bits, found
