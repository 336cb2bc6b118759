"""Compressed scenes that are compared from many poses: best, paper, and baselines near paper's size."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from flexgs_edge.goals.choice import Choice
from flexgs_edge.packed.bitspec import BitSpec
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.studies.paper.pruning import nearest
from flexgs_edge.studies.stability.breaks import drawn
from flexgs_edge.studies.stability.ours import Whole
from flexgs_edge.studies.study_scene import Setting, StudyScene

BEST, PAPER, RTN, ROWS, SH = "best", "paper", "RTN, 8 bits", "rows only", "SH only"
MARGIN = "best, --views-margin"
WORDS = (
    f"best and paper: the results at the study's target. {MARGIN}: generated poses are scored too. {RTN}: one "
    f"range a channel, nothing removed. {ROWS}, {SH}: the paper's bits, with only Gaussians or only SH removed by gs, to "
    "paper's bytes or as near as possible."
)


class Contenders:
    """The compressed scenes, by name.

    `studied`: the scene. `ours`: the result of best. `guarded`: the result of best with generated poses
    (`--views-margin`).
    """

    def __init__(self, studied: StudyScene, ours: Whole, guarded: Whole) -> None:
        self.studied, self.wholes = studied, {BEST: ours, MARGIN: guarded}
        paper = Setting(studied.search.chosen.choice)
        size = studied.size(paper)
        self.settings = {
            PAPER: paper,
            RTN: Setting(bits=BitSpec.rtn(8), groups=1),
            ROWS: Setting(_of_size(studied, size, lambda rate: Choice(min(rate, 980), 0))),
            SH: Setting(_of_size(studied, size, lambda rate: Choice(0, rate))),
        }
        self.names = (*self.wholes, *self.settings)

    def size(self, name: str) -> int:
        """Bytes of the file."""
        return self.wholes[name].size if name in self.wholes else self.studied.size(self.settings[name])

    @contextmanager
    def loaded(self, name: str) -> Iterator[DeviceScene]:
        """The decoded scene of its file, loaded to draw."""
        if name in self.wholes:
            with self.studied.bench.renderer.load(self.wholes[name].source) as scene:
                yield scene
        else:
            setting = self.settings[name]
            with drawn(self.studied, self.studied.evaluator(setting), setting.choice) as scene:
                yield scene


def _of_size(studied: StudyScene, size: int, choice: Callable[[int], Choice]) -> Choice:
    ladder = [choice(rate) for rate in range(1001)]
    sizes = [studied.size(Setting(one)) for one in ladder]
    place = nearest(sizes, size)
    # If a size is out of reach, the nearer end counts.
    return ladder[place] if place is not None else ladder[-1 if size < sizes[-1] else 0]
