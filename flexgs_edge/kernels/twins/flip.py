"""Twins of `cl_kernels/flip.cl`: LDR-FLIP of two pictures."""

import numpy as np

from flexgs_edge.constants import (
    FLIP_COLOUR_MOST,
    FLIP_COLOUR_POWER,
    FLIP_FEATURE_REACH,
    FLIP_FINE_REACH,
    FLIP_KNEE,
    FLIP_KNEE_SHARE,
    FLIP_LEAST,
    FLIP_REACH,
    FLIP_RGB,
    FLIP_XYZ,
)
from flexgs_edge.kernels.twins.arithmetic import Array, Size, f32, fexp2_within, flog2


def flip_power(x: Array, p: Array | np.float32) -> Array:
    """x^p for 0 <= x <= 1000 and 0 <= p <= 3."""
    none = x < f32(FLIP_LEAST)
    return np.where(none, f32(0), fexp2_within(p * flog2(np.where(none, f32(1), x))))


def _mix(parts: list[Array], weights: tuple[float, ...]) -> list[Array]:
    """A 3x3 matrix, row by row, times three arrays."""
    r, g, b = parts
    rows = (map(f32, weights[at : at + 3]) for at in (0, 3, 6))
    return [(wr * r + wg * g) + wb * b for wr, wg, wb in rows]


def flip_colours(size: Size, count: int, plane: int, planes: Array) -> None:
    """SRGB in [0, 1] becomes light, red against green and yellow against blue: Y, X - Y and Y - Z ([3, plane])."""
    linear = []
    for s in planes[:, :count]:
        curve = flip_power((s + f32(0.055)) / f32(1.055), f32(2.4))
        linear.append(np.where(s > f32(0.04045), curve, s / f32(12.92)))
    x, y, z = _mix(linear, FLIP_XYZ)
    planes[:, :count] = y, x - y, y - z


def _filter(values: Array, taps: Array, step: int, count: int, reach: int) -> Array:
    """Sums value * tap over 2 * `reach` + 1 elements `step` apart, for every element ([count])."""
    total = np.zeros(count, f32)
    for k in range(FLIP_REACH - reach, FLIP_REACH + reach + 1):
        total += taps[k] * values[k * step : k * step + count]
    return total


def flip_columns(
    size: Size, count: int, stride: int, plane: int, filtered: int, taps: Array, planes: Array, columns: Array
) -> None:
    """The planes filtered along the columns ([7, filtered]), by taps [7, 2 FLIP_REACH + 1]."""
    fine, wide, feature = FLIP_FINE_REACH, FLIP_REACH, FLIP_FEATURE_REACH
    of = ((0, fine), (1, fine), (2, wide), (2, wide), (0, feature), (0, feature), (0, feature))
    for to, tap, (channel, reach) in zip(columns, taps, of, strict=True):
        to[:count] = _filter(planes[channel], tap, stride, count, reach)


def _curve(t: Array) -> Array:
    """CIE's lightness curve of one of X, Y, Z."""
    edge = f32(6) / f32(29)
    root = flip_power(t, f32(1) / f32(3))
    return np.where(t > edge * edge * edge, root, t / (f32(3) * edge * edge) + f32(4) / f32(29))


def flip_rows(size: Size, count: int, filtered: int, taps: Array, columns: Array, seen: Array) -> None:
    """What is compared ([5, count]): L, a and b of the filtered colour, strength of edges and of points."""

    def along(column: int, tap: int, reach: int) -> Array:
        return _filter(columns[column], taps[tap], 1, count, reach)

    light, red = along(0, 0, FLIP_FINE_REACH), along(1, 1, FLIP_FINE_REACH)
    blue = along(2, 2, FLIP_REACH) + along(3, 3, FLIP_REACH)
    rgb = [
        np.minimum(np.maximum(value, f32(0)), f32(1)) for value in _mix([light + red, light, light - blue], FLIP_RGB)
    ]
    fx, fy, fz = map(_curve, _mix(rgb, FLIP_XYZ))
    lightness = f32(116) * fy - f32(16)
    hunt = f32(0.01) * lightness
    seen[:3] = lightness, hunt * (f32(500) * (fx - fy)), hunt * (f32(200) * (fy - fz))
    edge_x, edge_y = along(4, 5, FLIP_FEATURE_REACH), along(5, 4, FLIP_FEATURE_REACH)
    point_x, point_y = along(4, 6, FLIP_FEATURE_REACH), along(6, 4, FLIP_FEATURE_REACH)
    seen[3] = np.sqrt(edge_x * edge_x + edge_y * edge_y)
    seen[4] = np.sqrt(point_x * point_x + point_y * point_y)


def flip_pair(size: Size, count: int, one: Array, two: Array, flip: Array) -> None:
    """FLIP of two pictures ([count]): the difference of colours, raised by that of edges and points."""
    away = one - two
    colour = np.abs(away[0]) + np.sqrt(away[1] * away[1] + away[2] * away[2])
    power, knee, share = flip_power(colour, f32(FLIP_COLOUR_POWER)), f32(FLIP_KNEE), f32(FLIP_KNEE_SHARE)
    above = share + (power - knee) / (f32(FLIP_COLOUR_MOST) - knee) * (f32(1) - share)
    of_colour = np.where(power < knee, share / knee * power, above)
    of_feature = np.sqrt(np.maximum(np.abs(away[3]), np.abs(away[4])) * f32(0.70710678))
    flip[:] = flip_power(of_colour, f32(1) - of_feature)
