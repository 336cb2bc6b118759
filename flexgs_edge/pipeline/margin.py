"""Poses that nobody took: between the ones there are, nearer to what they look at and farther from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flexgs_edge.cameras import Camera
from flexgs_edge.render import Renderer, Statistics
from flexgs_edge.scene import SceneSource

NEARER, FARTHER = 0.5, 2.0
"""Distances of poses that are made, as parts of their own pose's. They come on top: in the place of 16 of 48 given ones they cost
fox 22 % of its bytes. One for each given pose, since half as many left the sample (balanced) 3.6 dB below its training poses'
fidelity at half the distance, where none leaves it 5.1 dB and this 2.9 dB; docs/guards.md has all figures."""
BETWEEN, FAR = 3, (2, 6)
"""Turns, of eight, of the other kinds."""
MIDDLE = 3
"""What a pose looks at is in the middle one of so many parts of its frame, across and down."""


def middle_of(camera: Camera) -> Camera:
    """The middle of a camera's frame, as a camera of its own: the same pixels."""
    left, top = (pixels // 2 - pixels // (2 * MIDDLE) for pixels in (camera.width, camera.height))
    return replace(
        camera,
        width=max(camera.width // MIDDLE, 1),
        height=max(camera.height // MIDDLE, 1),
        cx=camera.cx - left,
        cy=camera.cy - top,
    )


def visible_depths(renderer: Renderer, source: SceneSource, cameras: Sequence[Camera]) -> list[float]:
    """Distance of each camera to what it looks at, scene units: the median depth of the light in the middle of its frame.

    A camera that sees nothing there gets the median of the others, and 1 where none sees anything.
    """
    means = source.read(slice(0, source.count), ["means"])["means"]
    depths = []
    with renderer.load(source) as scene:
        for camera in map(middle_of, cameras):
            statistics = Statistics.zeros(source.count)
            renderer.add_statistics(scene, camera, statistics)
            rows = np.flatnonzero(statistics.weights)
            moved = camera.moved(source.origin)
            depth = moved.rotation[2] @ means[:, rows].astype(np.float64) + moved.translation[2]
            order = np.argsort(depth, kind="stable")
            light = np.cumsum(statistics.weights[rows][order])
            depths.append(float(depth[order[np.searchsorted(light, light[-1] // 2)]]) if len(rows) else np.nan)
    renderer.release()
    known = [depth for depth in depths if depth == depth]
    usual = float(np.median(known)) if known else 1.0
    return [depth if depth == depth else usual for depth in depths]


def at_distance(camera: Camera, depth: float, factor: float) -> Camera:
    """The pose moved along its axis: `factor` times as far from what lies at `depth`."""
    # Along the camera's own axis only the third part of the translation changes.
    moved = camera.translation + np.array([0.0, 0.0, (factor - 1) * depth])
    return replace(camera, name=f"{camera.name} at {factor:g}x", translation=moved)


def between(first: Camera, second: Camera) -> Camera:
    """The pose half way between two, with the first one's lens: the middle of the places, the nearest rotation to the mean."""
    left, _, right = np.linalg.svd(first.rotation + second.rotation)
    rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    center = (first.center + second.center) / 2
    return replace(first, name=f"{first.name} to {second.name}", rotation=rotation, translation=-rotation @ center)


def with_margin(renderer: Renderer, source: SceneSource, cameras: Sequence[Camera], most: int) -> list[Camera]:
    """At most `most` of `cameras` to score, the first ones, and one made from each of them.

    Of eight that are made five are `NEARER`, two `FARTHER` and one is half way to the nearest pose, each from another pose.

    Parameters
    ----------
    renderer : Renderer
        With nothing loaded.
    source : SceneSource
        The original.
    cameras : sequence of Camera
        All training poses, the most important first.
    """
    real = list(cameras[:most])
    made = []
    for place, (camera, depth) in enumerate(zip(real, visible_depths(renderer, source, real))):
        turn = place % 8
        others = [other for other in cameras if other is not camera]
        if turn == BETWEEN and others:
            away = [float(np.linalg.norm(other.center - camera.center)) for other in others]
            made.append(between(camera, others[int(np.argmin(away))]))
        else:
            made.append(at_distance(camera, depth, FARTHER if turn in FAR else NEARER))
    return real + made
