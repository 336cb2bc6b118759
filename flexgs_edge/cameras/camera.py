"""A pinhole camera, and operations on lists of cameras: split, limit, scale."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from flexgs_edge.cameras.lens import Lens, fitting_zoom
from flexgs_edge.constants import DEFAULT_HOLDOUT, DILATION
from flexgs_edge.errors import InputError
from flexgs_edge.small_matrices import inverse, product


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera: `p = rotation @ x + translation`, pixel `(fx p_x / p_z + cx, fy p_y / p_z + cy)`.

    Camera space is COLMAP's (x right, y down, z forward); the centre of the first pixel is (0, 0).

    `width`, `height`: pixels. `fx`, `fy`: focal lengths, pixels. `cx`, `cy`: principal point, pixels, integer pixel
    centres: (W - 1) / 2 is the middle.
    """

    name: str  # photos are matched, and views sorted, by this name
    width: int
    height: int
    rotation: np.ndarray  # [3, 3] f64, world to camera
    translation: np.ndarray  # [3] f64, scene units
    fx: float
    fy: float
    cx: float
    cy: float
    # Why photos of this camera do not match its renders: a lens distortion that was ignored, or an assumed field of
    # view. The pose serves for scores.
    distortion: str | None = None
    lens: Lens | None = None  # the lens of its photos, which are freed of it when they are loaded
    dilation: float = DILATION  # added to both diagonal terms of the 2D covariance, px^2

    def __post_init__(self) -> None:
        for field, shape in (("rotation", (3, 3)), ("translation", (3,))):
            array = np.array(getattr(self, field), np.float64)
            if array.shape != shape:
                raise InputError(f"camera {self.name!r}: {field}: expected shape {shape}, found {array.shape}")
            array.flags.writeable = False
            object.__setattr__(self, field, array)

    @cached_property
    def center(self) -> np.ndarray:
        """[3] f64, the camera's place in the world."""
        # Not by the transpose: files keep rotations to six digits, which 1e6 units from the origin is an error of a
        # unit.
        place = product(inverse(self.rotation), -self.translation)
        place.flags.writeable = False
        return place

    def scaled(self, width: int, height: int) -> Camera:
        """The same view at another size in pixels."""
        if width < 1 or height < 1:
            raise InputError(f"camera {self.name!r}: size {width}x{height}: expected at least 1x1")
        across, down = width / self.width, height / self.height
        # The edge of the image stays in place, not the centre of its first pixel: hence the half pixels.
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * across,
            fy=self.fy * down,
            cx=(self.cx + 0.5) * across - 0.5,
            cy=(self.cy + 0.5) * down - 0.5,
        )

    def behind(self, lens: Lens) -> Camera | None:
        """The pinhole that takes the place of `lens` with these intrinsics; None if photos cannot be freed of it."""
        zoom = fitting_zoom(lens, self.width, self.height, self.fx, self.fy, self.cx, self.cy)
        if zoom is None:
            return None
        return replace(self, fx=self.fx * zoom, fy=self.fy * zoom, lens=replace(lens, zoom=zoom), distortion=None)

    def every(self, step: float, column: float = 0, row: float = 0) -> Camera:
        """The view at points `step` pixels apart in both directions, from the place (`column`, `row`) on.

        Places count from the middle of the first pixel, and no point lies beyond the middle of the last one. Colours stay
        the same. It raises `InputError` if no point is left.
        """
        sides = (self.width - 1 - column, self.height - 1 - row)
        width, height = (math.floor(side / step) + 1 for side in sides)
        if not (0 <= column < step and 0 <= row < step) or width < 1 or height < 1:
            raise InputError(
                f"camera {self.name!r}: every {step} pixels from ({column}, {row}): no such pixels in {self.width}x{self.height}"
            )
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx / step,
            fy=self.fy / step,
            cx=(self.cx - column) / step,
            cy=(self.cy - row) / step,
            dilation=self.dilation / step**2,
        )

    def moved(self, origin: np.ndarray) -> Camera:
        """The same view for a scene whose positions are relative to `origin` ([3] f64, world)."""
        return replace(self, translation=self.translation + product(self.rotation, np.asarray(origin, np.float64)))


def distinct_names(names: Sequence[str]) -> list[str]:
    """Append `#` and the place in the list to every name that appears more than once, since names order the views.

    >>> distinct_names(["a", "b", "a"])
    ['a#0', 'b', 'a#2']
    """
    result = list(names)
    while len(set(result)) < len(result):
        count = Counter(result)
        result = [f"{name}#{place}" if count[name] > 1 else name for place, name in enumerate(result)]
    return result


def split_views(count: int, holdout: int = DEFAULT_HOLDOUT) -> tuple[list[int], list[int]]:
    """Split views into those to train on and those held out, as indices into the list sorted by name.

    `count`: number of views. `holdout`: every `holdout`-th view (index % holdout == 0) is held out; 0 holds out none.

    >>> split_views(5, 2)
    ([1, 3], [0, 2, 4])
    """
    if holdout < 0 or holdout == 1:
        raise InputError(f"--holdout {holdout}: expected 0 (hold out none) or 2 and more (every such view)")
    if holdout == 0:
        return list(range(count)), []
    return [i for i in range(count) if i % holdout], list(range(0, count, holdout))


def limit_width(cameras: Sequence[Camera], max_width: int) -> tuple[list[Camera], str | None]:
    """Scale views wider than `max_width` pixels down to this width, with the same aspect.

    Returns `cameras`: In the same order. Heights are rounded down, as in the reference training program. `note`: How
    many views were scaled, for the summary.
    """
    if max_width < 1:
        raise InputError(f"--resolution {max_width}: expected a width of at least 1 pixel")
    limited = [
        camera.scaled(max_width, max(1, camera.height * max_width // camera.width))
        if camera.width > max_width
        else camera
        for camera in cameras
    ]
    changed = sum(camera.width > max_width for camera in cameras)
    views = "1 view" if changed == 1 else f"{changed} views"
    return limited, f"{views} scaled down to {max_width} pixels wide" if changed else None


def largest_of(cameras: Sequence[Camera]) -> Camera:
    """The camera with the most pixels."""
    return max(cameras, key=lambda camera: camera.width * camera.height)
