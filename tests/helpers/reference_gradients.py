"""Gradients of a view's squared error in float64 by finite differences, and how far float32 may be from them.

The expected values come from the float64 renderer alone. The bound follows the roundings of the written forms: of every pixel's
terms, of their sums in fixed point, and (on the twin's own code, with `Bounded` numbers) of the way back to stored values.
"""

from __future__ import annotations

from dataclasses import dataclass
from unittest import mock

import numpy as np

import bounded
import reference_renderer
from bounded import Bounded, stacked
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.constants import FIXED_MOMENT, FIXED_WEIGHT, LOG2_E
from flexgs_edge.kernels.twins import backward
from flexgs_edge.methods.best.refit.descent import widths
from flexgs_edge.scene.source import MemorySource
from reference_renderer import EPS, _project, _Splats, alphas

Planes = dict[str, np.ndarray]
NEAR = 0.2
CHANGE = 1e-5
"""Of a value, as a share of itself and a tenth, for finite differences: their own error is about its square."""
DIFFERENCES = 1e-8
"""What they may be off by, as a share of a field's largest gradient."""
SUM_STEPS = 24
"""Roundings on the way of a pixel's term to its tile's sum, at most: 16 blocks, a tree of 16 lanes, and the unit."""


@dataclass
class Frozen:
    """Which splats each pixel blends, and where alpha is held at its cap: gradients are those between thresholds."""

    order: list[int]
    hits: np.ndarray
    capped: np.ndarray


@dataclass
class View:
    """What a gradient depends on beside the scene."""

    camera: Camera
    target: np.ndarray
    background: tuple[float, float, float]
    antialiased: bool

    @property
    def pixels(self) -> tuple[np.ndarray, np.ndarray]:
        return np.arange(self.camera.width)[None, :], np.arange(self.camera.height)[:, None]

    @property
    def wanted(self) -> np.ndarray:
        """[H, W, 3] f64."""
        height, width = self.camera.height, self.camera.width
        return self.target.astype(np.float64)[:, :height, :width].transpose(1, 2, 0)

    def splats(self, arrays: Planes, degree: int) -> _Splats:
        return _project(arrays, degree, self.camera, NEAR, self.antialiased)


def frozen_decisions(splats: _Splats, view: View) -> Frozen:
    """Decisions as the splats are."""
    xs, ys = view.pixels
    shape = len(splats.depth), view.camera.height, view.camera.width
    order = [int(k) for k in np.argsort(splats.depth, kind="stable") if splats.shown[k]]
    hits, capped = np.zeros(shape, bool), np.zeros(shape, bool)
    alive, trans = np.ones(shape[1:], bool), np.ones(shape[1:])
    for k in order:
        alpha, _, capped[k] = alphas(splats, k, xs, ys)
        seen = alive & (alpha >= reference_renderer.ALPHA_MIN)
        hits[k] = seen & (trans * (1 - alpha) >= reference_renderer.STOP)
        alive &= ~(seen & ~hits[k])
        trans = np.where(hits[k], trans * (1 - alpha), trans)
    return Frozen(order, hits, capped)


def blended(splats: np.ndarray, view: View, frozen: Frozen) -> np.ndarray:
    """[H, W, 3] of splats ([n, 9]: mean, conic, opacity, colour) with decisions frozen."""
    xs, ys = view.pixels
    trans, image = (
        np.ones((view.camera.height, view.camera.width)),
        np.zeros((view.camera.height, view.camera.width, 3)),
    )
    for k in frozen.order:
        mx, my, a, b, c, opacity, *colour = splats[k]
        dx, dy = xs - mx, ys - my
        full = opacity * np.exp(-(a * dx * dx + 2 * b * dx * dy + c * dy * dy) / 2)
        alpha = np.where(frozen.capped[k], reference_renderer.ALPHA_MAX, full) * frozen.hits[k]
        image += (alpha * trans)[..., None] * colour
        trans = trans * (1 - alpha)
    return image + trans[..., None] * np.array(view.background)


def values(splats: _Splats) -> np.ndarray:
    """[n, 9] for `blended`."""
    return np.column_stack([splats.mean, splats.conic, splats.opacity, splats.colour])


def expected_gradients(planes: Planes, degree: int, view: View) -> Planes:
    """[width, n] f64 of every field: through the splats' nine numbers, all by central differences."""
    arrays = {name: plane.astype(np.float64) for name, plane in planes.items()}
    splats = view.splats(arrays, degree)
    frozen, numbers = frozen_decisions(splats, view), values(splats)
    outer = np.zeros_like(numbers)
    for row in frozen.order:
        for k, number in enumerate(numbers[row]):
            change, errors = CHANGE * (abs(number) + 0.1), []
            for sign in (1, -1):
                moved = numbers.copy()
                moved[row, k] = number + sign * change
                errors.append(np.square(blended(moved, view, frozen) - view.wanted).sum())
            outer[row, k] = (errors[0] - errors[1]) / (2 * change)
    found = {}
    for name, width in widths(degree).items():
        found[name] = np.zeros((width, len(numbers)))
        for plane in range(width):
            change = CHANGE * (abs(arrays[name][plane]) + 0.1)
            either = []
            for sign in (1, -1):
                moved = arrays[name].copy()
                moved[plane] += sign * change
                either.append(values(view.splats({**arrays, name: moved}, degree)))
            slope = (either[0] - either[1]) / (2 * change[:, None])
            found[name][plane] = np.where(frozen.hits.any(axis=(1, 2)), (slope * outer).sum(axis=1), 0.0)
    return found


def allowed_errors(planes: Planes, degree: int, view: View) -> Planes | None:
    """[width, n] f64, or None where a decision of some pixel lies within rounding of its threshold."""
    reference = reference_renderer.render(
        MemorySource(planes), view.camera, NEAR, view.background, antialiased=view.antialiased
    )
    arrays = {name: plane.astype(np.float64) for name, plane in planes.items()}
    splats = view.splats(arrays, degree)
    sums = _sums(splats, frozen_decisions(splats, view), view, reference)
    if sums is None:
        return None
    # As records hold it: the exponent of 2, halved on the diagonal. Places before the conic are not looked at.
    units = LOG2_E * np.array([0.5, 1, 0.5])
    record = np.zeros((2, len(splats.depth), 9))
    record[0, :, 2:5], record[1, :, 2:5] = splats.conic * units, splats.conic_error * units
    record[0, :, 6:], record[1, :, 6:] = splats.colour, splats.colour_error[:, None]
    with mock.patch.multiple(backward, fma=bounded.fma, dot3=bounded.dot3, fexp2=bounded.fexp2):
        found = _way_back({k: Bounded(v) for k, v in arrays.items()}, degree, view, Bounded(*record).rounded(), sums)
    errors, at = {}, 0
    for name, width in widths(degree).items():
        errors[name] = found.error[at : at + width]
        at += width
    return errors


def _camera(camera: Camera) -> Bounded:
    """The record's places that a way back looks at."""
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    size = np.array([camera.width, camera.height])
    margin = 0.15 * size / focal
    low, high = -(centre + 0.5) / focal - margin, (size - 0.5 - centre) / focal + margin
    record = np.zeros(32)
    record[:12] = *camera.rotation.ravel(), *camera.translation
    record[12:16], record[17:21] = (*focal, *centre), (low[0], high[0], low[1], high[1])
    record[21:24] = camera.center
    return Bounded.of(record)


def _way_back(arrays: dict[str, Bounded], degree: int, view: View, record: Bounded, sums: Bounded) -> Bounded:
    """[14 + 3 K, n] from sums ([n, 9]), in the twin's own code."""
    camera, means = _camera(view.camera), arrays["means"]
    degrees = np.full(len(sums), degree)
    colours, toward = backward._colours(degree, camera, means, arrays["sh_rest"], degrees, record, sums)  # type: ignore[arg-type]
    shape = arrays["log_scales"], arrays["quats"]
    geometry = backward._geometry(int(view.antialiased), camera, means, *shape, record, sums, toward)  # type: ignore[arg-type]
    opacity = 1.0 / (1.0 + bounded.fexp2(arrays["opacity_logits"][0] * -LOG2_E))
    return stacked([*geometry, sums.T[3] * (1.0 - opacity), *colours])


def _sums(splats: _Splats, frozen: Frozen, view: View, reference: reference_renderer.Reference) -> Bounded | None:
    """[n, 9]: gradients of colours, exponent and its moments, as the kernel sums them up; None as for `allowed_errors`."""
    xs, ys = view.pixels
    image = Bounded(reference.image.transpose(2, 0, 1), reference.bound[None].repeat(3, axis=0))
    residual = Bounded(view.wanted.transpose(2, 0, 1)) - image
    behind, trans = bounded.dot3(*image, *residual), Bounded(np.ones(reference.bound.shape))
    tiles = -(-view.camera.width // 16) * -(-view.camera.height // 16)
    units = np.array([FIXED_WEIGHT] * 4 + [FIXED_MOMENT] * 5)
    sums = np.zeros((2, len(splats.depth), 9))
    if reference.fragile.any():
        return None
    for k in frozen.order:
        alpha, error, capped = alphas(splats, k, xs, ys)
        if (frozen.hits[k] & (abs(alpha - reference_renderer.ALPHA_MAX) <= error) & ~capped).any():
            return None
        own = Bounded(alpha, error)
        clear = 1.0 - own
        weight = np.where(frozen.hits[k], own * trans, 0.0)
        light = weight * bounded.dot3(*Bounded(splats.colour[k], [splats.colour_error[k]] * 3), *residual)
        behind = behind - light
        slope = np.where(frozen.hits[k] & ~capped, light - np.where(frozen.hits[k], own / clear, 0.0) * behind, 0.0)
        dx, dy = (Bounded(p - m, e) for p, m, e in zip((xs, ys), splats.mean[k], splats.mean_error[k], strict=True))
        dx, dy = dx.rounded() + 0.0 * alpha, dy.rounded() + 0.0 * alpha
        across, down = slope * dx, slope * dy
        terms = [*(weight * part for part in residual), slope, across, down, across * dx, across * dy, down * dy]
        for place, term in enumerate(terms):
            sums[0, k, place] = term.value.sum()
            sums[1, k, place] = term.error.sum() + SUM_STEPS * EPS * abs(term.value).sum() + tiles / units[place]
        trans = np.where(frozen.hits[k], trans * clear, trans)
    return Bounded(*(-2 * sums)[:1], *(2 * sums)[1:]).rounded()
