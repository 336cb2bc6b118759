"""Scenes whose numbers are where kernels break: at the ends of what a file may hold, on thresholds, in crowds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource
from synthetic import look_from, make_camera, make_splats, random_scene


@dataclass(frozen=True)
class Extreme:
    """One kind of scene and the view of it.

    Parameters
    ----------
    scene : callable
        Makes it.
    camera : Camera
    antialiased : bool
        Draw with compensated opacities.
    sure : float
        Share of the pixels on which no decision may be on the edge: where the bound says something.
    edges : int
        Pixels at least with a decision on the edge.
    bound : float
        What the median of the bound on a pixel's error may be, as a share of the image's largest value: a bound that lets
        anything pass would test nothing.
    """

    scene: Callable[[], MemorySource]
    camera: Camera
    antialiased: bool = False
    sure: float = 0.97
    edges: int = 0
    bound: float = 3e-4


_CAMERA = make_camera(45, 37, rotation=look_from(1)[0], translation=look_from(1)[1])
AHEAD = make_camera(48, 32)


def changed(count: int, seed: int, degree: int = 0, **planes: object) -> MemorySource:
    """`random_scene` with some planes set to other values."""
    arrays = random_scene(count, seed, degree).read(slice(0, count), list(FIELD))
    for name, values in planes.items():
        arrays[name][...] = values
    return MemorySource(arrays, degree)


def _logits() -> MemorySource:
    ends = [-40, -20, -6, np.log(1 / 254) - 1e-3, np.log(1 / 254) + 1e-3, -4, 0, 4, 20, 40]
    return changed(40, 60, opacity_logits=np.repeat(ends, 4))


def _scales(low: float, high: float) -> Callable[[], MemorySource]:
    return lambda: changed(40, 61, log_scales=np.linspace(low, high, 40), opacity_logits=-2)


def _needles(length: float) -> Callable[[], MemorySource]:
    """1e6 : 1, `length` scene units long (ten times as many pixels at the depth of the scene), in all directions."""
    return lambda: changed(24, 62, log_scales=np.log([[length], [1e-6 * length], [1e-6 * length]]))


def _flat() -> MemorySource:
    """Discs without thickness, a third of them seen from the side."""
    arrays = changed(30, 63, log_scales=[[-1.5], [-1.0], [-87.0]]).read(slice(0, 30), list(FIELD))
    arrays["quats"][:, ::3] = np.array([[1], [1], [0], [0]])
    return MemorySource(arrays)


def _quaternions() -> MemorySource:
    """Norms from the smallest to the largest that a reader lets through, and opposite ones."""
    arrays = random_scene(36, 64, 1).read(slice(0, 36), list(FIELD))
    unit = arrays["quats"] / np.linalg.norm(arrays["quats"], axis=0)
    arrays["quats"][...] = unit * np.repeat([2e-19, 1e-10, 1, -1, 1e10, 1.8e19], 6).astype(np.float32)
    return MemorySource(arrays, 1)


def _colours(size: float) -> Callable[[], MemorySource]:
    """Constants and SH of +-`size`: half of all colours are below zero."""

    def make() -> MemorySource:
        arrays = random_scene(40, 65, 3).read(slice(0, 40), list(FIELD))
        arrays["sh_dc"] *= np.float32(size)
        arrays["sh_rest"] *= np.float32(size)
        return MemorySource(arrays, 3)

    return make


def _equal_depths() -> MemorySource:
    """4000 in one plane, faint enough for a hundred to show in a pixel, in an order that is not that of their positions."""
    rng = np.random.default_rng(66)
    means = np.stack([rng.uniform(-1.4, 1.4, 4000), rng.uniform(-1.0, 1.0, 4000), np.full(4000, 4.0)], axis=1)
    return make_splats(means, np.full((4000, 3), 0.1), opacity=0.05, colours=rng.uniform(0, 1, (4000, 3)))


def _near_plane() -> MemorySource:
    """Centres on both sides of the plane and of the camera, splats larger than their distance to both."""
    depths = np.array([-5, -0.3, -1e-6, 0, 1e-6, 0.1, 0.1999, 0.2, 0.2001, 0.21, 0.25, 0.4, 1, 3], np.float32)
    rng = np.random.default_rng(67)
    means = np.stack([rng.uniform(-0.1, 0.1, depths.size), rng.uniform(-0.1, 0.1, depths.size), depths], axis=1)
    return make_splats(means, rng.uniform(0.02, 0.4, (depths.size, 3)), rng.uniform(0, 3, depths.size), 0.3)


def _one_pixel() -> MemorySource:
    """1e5 splats: faint ones over the whole image, more than it takes to end every pixel."""
    rng = np.random.default_rng(68)
    count = 100_000
    arrays = {
        "means": np.stack([rng.normal(0, 0.01, count), rng.normal(0, 0.01, count), rng.uniform(1, 9, count)]),
        "sh_dc": rng.normal(0, 1, (3, count)),
        "sh_rest": np.zeros((0, count)),
        "opacity_logits": rng.uniform(-5.5, -5, (1, count)),
        "log_scales": rng.uniform(-3, -2, (3, count)),
        "quats": rng.normal(size=(4, count)),
    }
    return MemorySource({name: values.astype(np.float32) for name, values in arrays.items()})


def _threshold() -> MemorySource:
    """Stacks that reach T = 1e-4 in steps whose product is 1e-4 but for rounding, each at the middle of a pixel."""
    steps = [(0.99, 0.99), (0.9, 0.9, 0.9, 0.9), (0.99, 0.9, 0.9), (0.9999, 0.99), (0.9, 0.99, 0.9), (0.9, 0.9, 0.99)]
    means, opacities = [], []
    for place, stack in enumerate(steps):
        x, y = (12 * (place % 3 - 1) + 0.5) / AHEAD.fx, (12 * (place // 3) - 6.5) / AHEAD.fy
        for step, opacity in enumerate((*stack, 0.3, 0.02)):
            z = 4 + 0.125 * step
            means.append([x * z, y * z, z])
            opacities.append(opacity)
    return make_splats(np.array(means), np.full((len(means), 3), 0.15), opacity=np.array(opacities))


def _alone() -> MemorySource:
    return changed(1, 69, 2, opacity_logits=3, log_scales=-1)


def _behind() -> MemorySource:
    source = random_scene(20, 70)
    arrays = source.read(slice(0, 20), list(FIELD))
    arrays["means"][2] *= -1
    return MemorySource(arrays)


EXTREMES = {
    "opacity logits +-40": Extreme(_logits, _CAMERA),
    "log-scales -50 to -5": Extreme(_scales(-50, -5), _CAMERA),
    "log-scales -5 to 3": Extreme(_scales(-5, 3), _CAMERA),
    "log-scales 3 to 20": Extreme(_scales(3, 20), _CAMERA, sure=0.5, bound=1e-2),
    "log-scales -50 to 20, antialiased": Extreme(_scales(-50, 20), _CAMERA, True, sure=0.5, bound=1e-2),
    "needles of 3 pixels": Extreme(_needles(0.3), _CAMERA),
    "needles of 30 pixels": Extreme(_needles(3), _CAMERA, sure=0.3, bound=0.1),
    "needles of 30 pixels, antialiased": Extreme(_needles(3), _CAMERA, True),
    "flat splats": Extreme(_flat, _CAMERA),
    "flat splats, antialiased": Extreme(_flat, _CAMERA, True),
    "quaternions tiny, huge and opposite": Extreme(_quaternions, _CAMERA),
    "colours of +-1e4": Extreme(_colours(1e4), _CAMERA, bound=2e-3),
    "colours of +-1e6": Extreme(_colours(1e6), _CAMERA, bound=2e-3),
    "4000 equal depths": Extreme(_equal_depths, AHEAD, sure=0.5, bound=2e-3),
    "across the near plane and behind": Extreme(_near_plane, AHEAD),
    "1e5 splats on one pixel": Extreme(_one_pixel, make_camera(1, 1), sure=0, bound=1e-2),
    "transmittance at its threshold": Extreme(_threshold, AHEAD, edges=6),
    "an image of 1x1": Extreme(lambda: random_scene(60, 71, 2), make_camera(1, 1)),
    "an image of 16384x16": Extreme(
        lambda: random_scene(24, 72, spread=4), make_camera(16384, 16, focal=3000, centre=(8000.0, 7.0)), bound=2e-3
    ),
    "an image of 16x16384": Extreme(
        lambda: random_scene(24, 73, spread=4), make_camera(16, 16384, focal=3000, centre=(7.0, 9000.0)), bound=2e-3
    ),
    "one Gaussian": Extreme(_alone, _CAMERA),
    "none in view": Extreme(_behind, AHEAD),
}
"""Every row of the test, by its name."""
