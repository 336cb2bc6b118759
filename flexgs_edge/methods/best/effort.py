"""`--effort`: how much work the method `best` spends.

Work is counted and never timed, so the same command gives the same bytes.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.run import Run

LEAST_STEPS = 240
"""Least steps of a descent. Four rounds of a few poses mend less than they break: docs/results/tuning.md#least_steps"""
FINE_PASSES = 0.75  # Share of `Effort.passes` where poses have every pixel: docs/results/tuning.md#fine_passes
MANY_POSES = 125
"""Beyond so many poses, steps of a descent grow with the root of their number: docs/results/tuning.md#many_poses"""
LEAST_VIEWS = 6
"""Least poses for a step of the refit. Steps from fewer poses overfit the scored poses, and all others get worse:
docs/results/tuning.md#least_views"""

LARGEST_STEP = 4
"""Largest distance in pixels between the points that we look at. Splats of one or two pixels must not fall between them
in every view: docs/results/tuning.md#distances"""
STEP_UNIT = 1 / 32  # Distances are multiples of it, so that no last bit of a sum decides


@dataclass(frozen=True)
class Effort:
    """How much work a search spends, as fixed counts."""

    keep: float  # share of the Gaussians that stays in each round of pruning: docs/results/tuning.md#keep
    # Rounds of the refit on all coefficients before SH are put on their grid. One round on the constant follows. `fast`
    # has none, because they cost more time there than their bytes are worth: docs/results/tuning.md#refit_rounds
    refit_rounds: int
    subsets: int  # most steps of a round, as for `refit_colours`
    close: float  # a search ends when a candidate's log of the largest share is no farther than this below 0
    few: int  # least scored poses, if there are as many: docs/results/tuning.md#few
    views: int  # Most scored poses. We take more than `few` if these have too few pixels.
    # Points of all scored poses that we look at, for each Gaussian. There are more if they would lie farther apart than
    # `LARGEST_STEP`, and fewer if the poses have fewer pixels. More take longer, fewer make files larger:
    # docs/results/tuning.md#pixels
    pixels: int
    near: float  # A candidate whose log of the largest share is no farther than this below 0 loses no more Gaussians
    # Expected loss after the first round of the colour refit, divided by the loss before it, until a candidate tells.
    # The fewer pixels we fit, the less of the gain holds elsewhere. A value that is too low
    # makes the first candidate miss, and each further one costs a refit: docs/results/tuning.md#refitted
    refitted: float
    # The same after the first descent; later ones end half way, as logs, between the loss before them and what the one before
    # left: docs/results/tuning.md#distilled
    finetuned: float = 0.36
    probed: int = 8  # most poses that trial grids are measured on: docs/results/tuning.md#probed
    # How often the descent to a candidate looks at every scored pose, if there are no more than `MANY_POSES`. 0
    # (default): colours are refitted instead.
    passes: float = 0.0
    # Most descents between rounds of pruning, before the first candidate, so that pruning knows what mends itself:
    # docs/results/tuning.md#interleaved
    interleaved: int = 0
    # Least Gaussians of a scene that descends; of others, colours are refitted. Small scenes gain nothing by it:
    # docs/results/tuning.md#descends
    descends: int = 0

    def poses_of(self, pixels: Sequence[int], count: int) -> int:
        """How many poses to score for `count` Gaussians; `pixels` are those of each pose, in order."""
        enough = int(np.searchsorted(np.cumsum(pixels), self.pixels * count)) + 1
        return min(max(self.few, enough), self.views, len(pixels))

    def subsets_of(self, poses: int) -> int:
        """Steps of a round for `poses` scored poses."""
        return max(min(self.subsets, poses // LEAST_VIEWS), 1)


def sampling_steps(
    cameras: Sequence[Camera], pixels: int, coverage: float = 1.0, weights: np.ndarray | None = None
) -> list[float]:
    """The distance in pixels between the points that we look at, for each pose, from 1 to `LARGEST_STEP`.

    The distances are the largest that leave about `pixels` points in all. A pose of weight w gets about w times as many
    as one of weight 1, as errors add up over points.

    `cameras`: the poses. `pixels`: points of all poses together. `coverage`: share of the pixels that the scene covers,
    which alone count. Default: all. `weights`: [n] f64, above 0 to 1, one of them 1. Default: equal ones.
    """
    spread = [1.0] * len(cameras) if weights is None else [1.0 / math.sqrt(weight) for weight in weights.tolist()]
    widest = max(spread)

    def steps(factor: int) -> list[float]:
        farther = [math.floor(factor * each / widest) * STEP_UNIT for each in spread]
        return [min(max(step, 1.0), float(LARGEST_STEP)) for step in farther]

    # At the first factor all distances are the least, at the last one the largest.
    low, high = 1, math.ceil(LARGEST_STEP / STEP_UNIT * widest / min(spread))
    while low < high:
        middle = (low + high + 1) // 2
        if coverage * pixels_of(cameras, steps(middle)) >= pixels:
            low = middle
        else:
            high = middle - 1
    return steps(low)


def sampled_poses(cameras: Sequence[Camera], steps: Sequence[float]) -> list[Camera]:
    """The views at points so far apart; `steps` has the distance of each.

    Lattices begin at other places in each view, by the order of the views' names. Names do not depend on the order of the
    poses, where a moved scene may break ties in another way.
    """
    # Shares of a distance by which the lattice moves right and down from view to view: powers of the root of x^3 = x + 1,
    # whose multiples fill the unit square evenly.
    shifts = 0.7548776662466927, 0.5698402909980532
    places = np.argsort(np.argsort([camera.name for camera in cameras], kind="stable"), kind="stable")
    return [
        camera.every(step, *(step * (place * shift % 1.0) for shift in shifts)) if step > 1 else camera
        for place, camera, step in zip(places.tolist(), cameras, steps, strict=True)
    ]


def pixels_of(cameras: Sequence[Camera], steps: Sequence[float]) -> int:
    """About how many points all views have; `steps` has the distance of each."""
    return sum(int(camera.width * camera.height / step**2) for camera, step in zip(cameras, steps, strict=True))


_BALANCED = Effort(
    keep=0.8,
    refit_rounds=2,
    subsets=7,
    close=0.13,
    near=0.02,
    few=400,
    views=400,
    pixels=24,
    refitted=0.64,
    passes=8.0,
    interleaved=2,
    descends=10_000,
)
EFFORTS = {
    "fast": Effort(
        keep=0.77, refit_rounds=0, subsets=7, close=0.3, near=0.1, few=32, views=96, pixels=12, refitted=0.84, probed=4
    ),
    "balanced": _BALANCED,
    "max": _BALANCED,  # another word: more work gained less than a tenth on most scenes
}


def effort_of(run: Run[CompressOptions]) -> Effort:
    """The effort of a run.

    Whoever sets the steps of a descent gets one descent for each candidate, and no others. The same holds where automatic
    views judge quality: from elsewhere, what was fine-tuned to them and then pruned by them loses more than they tell.
    """
    plan = EFFORTS[run.options.effort]
    lone = run.seen.automatic and run.target.limit_bytes is None
    return replace(plan, interleaved=0) if lone or run.options.distil is not None else plan


def finetune_steps(options: CompressOptions, poses: int, count: int, fine: bool = False) -> int:
    """Steps of the descent to a candidate; 0 for none.

    `options`: effort, `distil` and `refit`. `poses`: scored poses. `count`: Gaussians of the scene. `fine`: the poses have
    every pixel: see `is_fine`.
    """
    if options.distil is not None:
        return options.distil
    plan = EFFORTS[options.effort]
    if not (plan.passes and options.refit and count >= plan.descends):
        return 0
    counted = min(poses, math.sqrt(MANY_POSES * poses))
    return max(round(plan.passes * (FINE_PASSES if fine else 1.0) * counted), LEAST_STEPS)
