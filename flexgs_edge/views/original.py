"""The original scene as refits and descents see it: its renders from some poses, and what draws the scene beside them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.views.references import References


@dataclass(frozen=True)
class Original:
    """The original from some poses."""

    renderer: Renderer  # draws the views
    origin: np.ndarray  # [3] f64, as in `SceneSource`
    cameras: Sequence[Camera]  # scored poses
    references: References  # renders of the original from `cameras`, then from `between`
    # Further poses, if there are descents. One that knew only the scored poses would fit these, and get worse between
    # them.
    between: Sequence[Camera] = ()
    progress: Progress = SILENT  # told of each view
    steps: int = 0  # steps of the descent to the first candidate; 0 (default): colours are refitted instead
    # [n] f64, above 0: how often a descent looks at each of `poses`, relative to the others. Default: alike.
    turns: np.ndarray | None = None

    @property
    def poses(self) -> list[Camera]:
        """All poses, in the order of their references."""
        return [*self.cameras, *self.between]
