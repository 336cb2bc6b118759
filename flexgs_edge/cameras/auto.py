"""Place cameras automatically around a scene that has none: where people stand, so that the Gaussians are seen as in training.

Candidates stand in lattices in and around the scene. They are drawn small, and their pictures judge them. A view is good where
the Gaussians that it shows are as fine as those around them (`detail`), fill the picture, and do not hang right before the
lens. SH above degree 0, where there are any, grow only along directions that cameras looked from. Views are picked one by one
for what they add, until they show what all good views together show. So their number follows from the scene.

The same scene gets the same cameras on any machine. What exponentials and powers yield is rounded to whole numbers
before it is added or compared, and no sum depends on the order of its terms.
"""

import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.candidates import MOST_VIEWS, Candidate, Show, Stage, ThingStage, look
from flexgs_edge.cameras.directions import Frames, bins_of, fibonacci, filled_share
from flexgs_edge.cameras.scene_sample import Gaussians, Part, SceneSample, sample_scene
from flexgs_edge.cameras.up import Stands, find_up, given_up
from flexgs_edge.constants import DEFAULT_HOLDOUT
from flexgs_edge.errors import InputError

LEAST_VIEWS = 40
PIXELS = 24  # Least pixels of all views for a Gaussian, up to MOST_VIEWS: fewer cannot tell what each is worth
DEFAULT_SIZE = (640, 480)
FIELD_OF_VIEW = math.radians(65.0)
"""Angle of view across the image's width; lenses of phones, and those usual in the field, have 40 to 70 degrees. Wide
views show a thing together with its background: a method that scores only some of the views then scores both."""
PLACES = 60
"""Places of the first lattices, in a scene of up to USUAL_COUNT Gaussians. Larger ones have more places, by the root."""
USUAL_COUNT = 200_000
ROUNDS, BEST = 2, 20
"""So often the best views, so many in the same proportion, get others beside them, and half as many Gaussians that none of them
shows well get places around them."""
OWN_VIEWS = DEFAULT_HOLDOUT  # Views of each thing, if there are several: one of them decides
OWN_PLACES, OWN_DISTANCE = 24, 2.3  # Places around a thing, so many half sides of its box away that it fills the frame
AROUND = 0.5  # A thing lies around another if it is there on more than this share of all sides
INNER_PLACES, INNER_SHARE = 8, 0.5  # Places inside what lies around others, so many half sides from its middle
CLOSE_UP_VIEWS = 16  # At most so many views tell whether what all others show small looks right from near by
DIRECTIONS = 192
NEAR_PLANE = 0.1  # A near plane up to this share of the usual distance leaves what is looked at
Drawing = Callable[[dict[str, np.ndarray]], AbstractContextManager[Show]]
"""Draws a small scene, {field: [width, M] f32}."""
MARGIN = 1.2  # A lattice reaches so many half sides of its box to each side
WIDER = (1, 2, 4)
"""Lattices of a core, in half sides of its box. Cameras often stood outside the dense core that they looked at."""
BETWEEN = 1.5  # Wider lattices end where they come this near to the size of the whole scene
CLOSE_UPS = 24  # Splats that get places of their own, if the scene is sparse
CLOSE_SIDES = 4  # Places around each of them
CLOSE_DISTANCE = 5.5
"""Distance of these places in deviations of the splat. Three deviations to each side then fill the frame."""
SPARSE = 0.5  # A scene is sparse if all its cross-sections together are less than this share of a circle around its box


@dataclass(frozen=True)
class CloseUp:
    """A view that is no camera of the rig, and shows some Gaussians much larger than all of these do."""

    camera: Camera
    place: tuple[float, float, float]  # what it looks at, world coordinates
    count: int  # so many Gaussians, about


@dataclass(frozen=True)
class Rig:
    """Automatic cameras."""

    # World coordinates, named auto_000, auto_001, ... Every `DEFAULT_HOLDOUT`-th one lies between others. The rest
    # are in order of what they add.
    cameras: list[Camera]
    near: float  # Scene units: a larger near plane would cut off what the views show
    note: str  # How the cameras were placed, for the summary
    close_ups: tuple[CloseUp, ...] = ()  # what shows much larger elsewhere than in the cameras


def automatic_rig(
    source: Gaussians,
    drawing: Drawing,
    views: int | None = None,
    width: int = DEFAULT_SIZE[0],
    height: int = DEFAULT_SIZE[1],
    up: np.ndarray | None = None,
) -> Rig:
    """Place cameras for a scene that has none; the same scene always gets the same cameras.

    `source`: checked: finite and not empty. `drawing`: draws candidates. `views`: number of cameras. Default: as
    many as the scene needs. `width`, `height`: pixels. `up`: [3], the direction of up in the scene's frame, of any
    length but zero. Default: what the scene itself tells, else -y. Raises `InputError` if less than one view is
    asked for.
    """
    if views is not None and views < 1:
        raise InputError(f"{views} automatic views: expected at least 1")
    scene = sample_scene(source)
    focal = width / 2 / math.tan(FIELD_OF_VIEW / 2)
    frames = Frames(DIRECTIONS, math.atan(math.sqrt(width * height / math.pi) / focal))
    share = math.sqrt(max(1.0, source.count / USUAL_COUNT))
    with drawing(scene.planes) as show:
        stage = Stage(scene, show, frames, focal / math.sqrt(width * height))
        at, steps = first_places(scene, round(PLACES * share))
        for eye, step in zip(at.T, steps):
            stage.add_place(eye, float(step))
        for _ in range(ROUNDS):
            stage.add_missing(round(BEST * share / 2))
            for view in stage.choose(round(BEST * share)):
                stage.add_beside(view)
        least = min(max(LEAST_VIEWS, PIXELS * source.count // (width * height)), MOST_VIEWS)
        chosen = stage.in_order(stage.choose(views, least)) or [_blind(scene)] * (views or LEAST_VIEWS)
        if views is None:
            numbers = range(len(scene.things))[: MOST_VIEWS // OWN_VIEWS]
            chosen = _joined([chosen, *(_own_views(scene, number, stage) for number in numbers)])
        seen = list(stage.views) or chosen
        ups = stage.close_ups(chosen, CLOSE_UP_VIEWS) if stage.views and views is None else []
    forward = np.array([view.line for view in chosen]).T
    at = np.array([view.at for view in chosen]).T
    stands = Stands(
        np.array([view.at for view in seen]).T, stage.strength if stage.views else np.ones(len(seen)), forward
    )
    found = find_up(scene, stands) if up is None else given_up(up)
    cameras = [
        look(f"auto_{index:03d}", view.at + source.origin, view.line, found.direction, width, height, focal)
        for index, view in enumerate(chosen)
    ]
    close_ups = tuple(
        CloseUp(
            look(f"near_{index}", view.at + source.origin, view.line, found.direction, width, height, focal),
            tuple((view.at + view.line * view.distance + source.origin).tolist()),
            count,
        )
        for index, (view, count) in enumerate(ups)
    )
    near = float(f"{NEAR_PLANE * min(view.distance for view in chosen):.2g}")
    seldom = round(stage.seldom * source.count)
    hidden = f"; {seldom} Gaussians show only from behind, from below or through others" if seldom else ""
    return Rig(cameras, near, f"{_placed(scene, at)}{hidden}; {found.note}", close_ups)


def _own_views(scene: SceneSample, number: int, stage: Stage) -> list[Candidate]:
    """Views of a thing from near by, and from inside if it lies around others. The first is to decide."""
    box, others = scene.things[number], scene.things[:number] + scene.things[number + 1 :]
    own = ThingStage(
        replace(scene, stands=np.where(scene.thing == number, scene.stands, 0.0)), stage.show, stage.frames, stage.lens
    )
    away = OWN_DISTANCE * float(box.half.max())
    rows = scene.means[:, scene.thing == number]
    if any(filled_share(bins_of(rows - other.middle[:, None])) > AROUND for other in others):
        for line in fibonacci(INNER_PLACES):
            own.add_place(box.middle + INNER_SHARE * box.half * line, float(box.half.min()))
    else:
        for line in fibonacci(OWN_PLACES):
            own.add_view(box.middle - away * line, line, away)
    for view in own.choose(OWN_VIEWS):
        own.add_beside(view)
    return own.in_order(own.choose(OWN_VIEWS))


def _joined(groups: list[list[Candidate]]) -> list[Candidate]:
    """Groups of views as one, in which every `DEFAULT_HOLDOUT`-th view is such a one of a group."""
    first = iter([view for group in groups for view in group[::DEFAULT_HOLDOUT]])
    rest = iter([view for group in groups for place, view in enumerate(group) if place % DEFAULT_HOLDOUT])
    count = sum(map(len, groups))
    turns = ((rest, first) if place % DEFAULT_HOLDOUT else (first, rest) for place in range(count))
    return [next(one, None) or next(other) for one, other in turns]


def _blind(scene: SceneSample) -> Candidate:
    """A view of a scene of which nothing can be drawn."""
    whole, none = scene.whole, np.zeros(0)
    at = whole.middle - np.array([0.0, 0.0, 3 * whole.extent])
    return Candidate(
        at, np.array([0.0, 0.0, 1.0]), 1.0, 1.0, none.astype(np.int64), none, none, 1.0, 0.0, 0.0, 0.0, whole.extent
    )


def _placed(scene: SceneSample, places: np.ndarray) -> str:
    whole = scene.whole
    inside = float(np.mean(np.all(np.abs(places - whole.middle[:, None]) < whole.half[:, None], axis=0)))
    kind = "inside out" if inside > 0.75 else "from outside" if inside < 0.25 else "from inside and outside"
    told = ", and SH are strong" if scene.telling.size else ""
    return f"{places.shape[1]} automatic views {kind}, placed where the scene looks sharp{told}"


def first_places(scene: SceneSample, count: int) -> tuple[np.ndarray, np.ndarray]:
    """About `count` candidates in and around the parts of a scene.

    Returns positions relative to the scene's origin ([3, P] f64), and distances to the next ones ([P] f64, scene units).
    """
    boxes = _boxes(scene.parts)
    found = [_lattice(box, count / len(boxes)) for box in boxes]
    if is_sparse(scene):
        found.append(_close_ups(scene))
    return np.concatenate([at for at, _ in found], axis=1), np.concatenate([step for _, step in found])


def is_sparse(scene: SceneSample) -> bool:
    """Say if a view of the whole scene would be almost empty."""
    return scene.area < SPARSE * scene.whole.extent**2


def _boxes(parts: list[Part]) -> list[Part]:
    boxes = [parts[0]]
    for part in parts[1:]:
        for factor in WIDER:
            wider = Part(part.middle, part.half * factor)
            if factor == 1 or wider.extent * BETWEEN < parts[0].extent:
                boxes.append(wider)
    return boxes


def _lattice(box: Part, count: float) -> tuple[np.ndarray, np.ndarray]:
    """A cubic lattice of about `count` places in and around a box."""
    reach = (1 + MARGIN) * np.maximum(box.half, 0.25 * box.half.max())
    step = 2 * float(np.cbrt(reach.prod() / count))
    axes = []
    for half in reach:
        sides = max(1, round(2 * float(half) / step))
        axes.append((np.arange(sides) + 0.5) * (2 * float(half) / sides) - float(half))
    at = np.stack(np.meshgrid(*axes, indexing="ij")).reshape(3, -1) + box.middle[:, None]
    return at, np.full(at.shape[1], step)


def _close_ups(scene: SceneSample) -> tuple[np.ndarray, np.ndarray]:
    """Places around the splats that show most."""
    order = np.argsort(-scene.sample.opacity * scene.sample.sizes**2, kind="stable")[:CLOSE_UPS]
    distances = CLOSE_DISTANCE * scene.sample.sizes[order]
    offsets = fibonacci(CLOSE_SIDES).T
    at = scene.sample.means[:, order, None] + distances[:, None] * offsets[:, None]
    return at.reshape(3, -1), np.repeat(distances / math.sqrt(CLOSE_SIDES), CLOSE_SIDES)
