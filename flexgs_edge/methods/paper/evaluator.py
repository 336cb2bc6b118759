"""Answers the questions of the search for a real scene: exact bytes of a choice, and its measured quality."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from flexgs_edge.codec.v1.header import container_size
from flexgs_edge.goals.steps import Choice
from flexgs_edge.goals.target import Measurement
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.methods.paper.prune import ranks_from_order, select_rows
from flexgs_edge.packed.bitspec import BitSpec
from flexgs_edge.packed.quantize import QuantizedScene, far_contraction, quantize_scene, quantized_bytes
from flexgs_edge.run.quality_evaluator import QualityEvaluator, measurement_of
from flexgs_edge.scene.source import SceneSource

QUANTIZE_COPIES = 4  # Copies of a chunk's planes that quantizing holds at once: as read, gathered, and codes in between


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
    def quantized(self, choice: Choice, bits: BitSpec | None = None) -> Iterator[QuantizedScene]:
        """The quantized scene of a choice; its bytes are taken from the budget while the block lasts."""
        kept, with_sh = self.counts(choice)
        bits = self.bits if bits is None else bits
        size = quantized_bytes(kept, with_sh, self.source.sh_degree if with_sh else 0, bits, self.groups)
        self.budget.take("the quantized scene", size)
        try:
            per_row = QUANTIZE_COPIES * 4 * (14 + self.source.width("sh_rest"))
            chunk_rows = self.budget.rows("quantizing", per_row, minimum=min(kept, 1024), most=65536)
            rows = select_rows(self._ranks, choice, self._has_sh)
            yield quantize_scene(self.source, *rows, bits, self.groups, chunk_rows, self._contraction)
        finally:
            self.budget.give(size)
