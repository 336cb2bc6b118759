"""A brute-force float64 renderer written from the semantics alone: every splat at every pixel, no tiles, no extents.

It shares no code and no constants with the package. Beside the image it carries a bound on what float32 arithmetic of the
written forms may differ by (first-order error propagation, one unit roundoff for each operation), and it marks the
decisions (alpha >= 1/255, T >= 1e-4) that lie within that bound: only those may fall the other way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import SceneSource

EPS = 2.0**-24
"""Unit roundoff of float32."""
EXP2_ERROR = 2.15e-7
LOG2_ERROR = 7.1e-8
ALPHA_MIN = 1 / 255
ALPHA_MAX = 0.99
STOP = 1e-4


@dataclass
class Reference:
    """What a view must look like, and how far float32 may be from it.

    Attributes
    ----------
    image, bound : np.ndarray
        [H, W, 3] and [H, W] f64: the image and the largest allowed difference of a channel.
    fragile : np.ndarray
        [H, W] bool: a decision of this pixel lies within rounding of its threshold; `bound` does not hold here.
    hits, unsure : np.ndarray
        [N] i64: pixels at which the splat is blended, and pixels at which that may fall either way.
    weights, weight_bound : np.ndarray
        [N] f64: sum of alpha T, and the largest allowed difference.
    shown : np.ndarray
        [N] bool: passed near plane, opacity and determinant.
    weights2 : np.ndarray
        [N] f64: sum of (alpha T)^2.
    removal : np.ndarray
        [N] f64: squared error of leaving the splat out with the hits of the others frozen.
    """

    image: np.ndarray
    bound: np.ndarray
    fragile: np.ndarray
    hits: np.ndarray
    unsure: np.ndarray
    weights: np.ndarray
    weight_bound: np.ndarray
    shown: np.ndarray
    weights2: np.ndarray
    removal: np.ndarray


@dataclass
class _Splats:
    """Projected Gaussians, [N] each, and the error bounds of their values."""

    shown: np.ndarray
    depth: np.ndarray
    mean: np.ndarray
    mean_error: np.ndarray
    cov: np.ndarray
    conic: np.ndarray
    conic_error: np.ndarray
    opacity: np.ndarray
    exponent_error: np.ndarray
    colour: np.ndarray
    colour_error: np.ndarray


def rotation_matrices(quats: np.ndarray) -> np.ndarray:
    """[N, 3, 3] from [4, N] quaternions w x y z of any norm."""
    w, x, y, z = quats / np.linalg.norm(quats, axis=0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


def sh_basis(degree: int, direction: np.ndarray) -> np.ndarray:
    """[(degree + 1)^2, n] real spherical harmonics (Condon-Shortley phase) of unit directions [n, 3], by Legendre's recursion."""
    x, y, z = direction.T
    azimuth, ring = np.arctan2(y, x), np.sqrt(np.maximum(0.0, 1 - z * z))
    legendre: dict[tuple[int, int], np.ndarray] = {}
    for m in range(degree + 1):
        legendre[m, m] = math.prod(range(1, 2 * m, 2)) * ring**m
        if m < degree:
            legendre[m + 1, m] = (2 * m + 1) * z * legendre[m, m]
        for n in range(m + 2, degree + 1):
            legendre[n, m] = ((2 * n - 1) * z * legendre[n - 1, m] - (n + m - 1) * legendre[n - 2, m]) / (n - m)
    basis = []
    for n in range(degree + 1):
        for order in range(-n, n + 1):
            m = abs(order)
            scale = math.sqrt((2 * n + 1) / (4 * math.pi) * math.factorial(n - m) / math.factorial(n + m))
            turn = math.sqrt(2) * (np.sin(m * azimuth) if order < 0 else np.cos(m * azimuth)) if m else np.ones_like(z)
            basis.append((-1) ** m * scale * turn * legendre[n, m])
    return np.array(basis)


def _project(arrays: dict[str, np.ndarray], degree: int, camera: Camera, near: float, antialiased: bool) -> _Splats:
    world = arrays["means"].T
    rotation, translation, size = camera.rotation, camera.translation, (camera.width, camera.height)
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    point = world @ rotation.T + translation
    point_error = 5 * EPS * (abs(world) @ abs(rotation.T) + abs(translation))
    depth = point[:, 2]
    logit = arrays["opacity_logits"][0]
    opacity = 1 / (1 + np.exp(-logit))
    # Depth, near plane and both opacities are compared as float32.
    shown = (depth.astype(np.float32) > np.float32(near)) & (opacity >= ALPHA_MIN)

    scale = np.exp(arrays["log_scales"].T)
    turn = rotation_matrices(arrays["quats"])
    matrix = turn * scale[:, None, :]
    scale_error = EXP2_ERROR + EPS * (1 + 3 * abs(arrays["log_scales"].T))
    matrix_error = (16 * EPS + abs(turn) * scale_error[:, None, :]) * scale[:, None, :]
    cov = matrix @ matrix.transpose(0, 2, 1)
    cov_error = abs(matrix) @ (2 * matrix_error + 3 * EPS * abs(matrix)).transpose(0, 2, 1)
    cov_error = np.maximum(cov_error, cov_error.transpose(0, 2, 1))

    slope = point[:, :2] / depth[:, None]
    slope_error = (point_error[:, :2] + abs(slope) * point_error[:, 2:]) / depth[:, None] + 2 * EPS * abs(slope)
    margin = 0.15 * np.array(size) / focal
    # The image's outer pixel edges: half a pixel beyond the outer centres.
    limits = (-(centre + 0.5) / focal - margin, (np.array(size) - 0.5 - centre) / focal + margin)
    clamped = np.clip(slope, *limits)
    jacobian, jacobian_error = np.zeros((2, len(depth), 2, 3))
    for axis in range(2):
        jacobian[:, axis, axis] = focal[axis] / depth
        jacobian[:, axis, 2] = -jacobian[:, axis, axis] * clamped[:, axis]
        relative = point_error[:, 2] / depth + 4 * EPS
        jacobian_error[:, axis, axis] = jacobian[:, axis, axis] * relative
        jacobian_error[:, axis, 2] = abs(jacobian[:, axis, 2]) * relative
        jacobian_error[:, axis, 2] += jacobian[:, axis, axis] * slope_error[:, axis]
    to_pixels = jacobian @ rotation
    to_pixels_error = jacobian_error @ abs(rotation) + 4 * EPS * abs(jacobian) @ abs(rotation)
    flat = to_pixels @ cov @ to_pixels.transpose(0, 2, 1) + 0.3 * np.eye(2)
    absolute = abs(to_pixels)
    flat_error = to_pixels_error @ abs(cov) @ absolute.transpose(0, 2, 1)
    flat_error = flat_error + flat_error.transpose(0, 2, 1) + absolute @ cov_error @ absolute.transpose(0, 2, 1)
    flat_error += 7 * EPS * (absolute @ abs(cov) @ absolute.transpose(0, 2, 1) + 0.3 * np.eye(2))

    a, b, c = flat[:, 0, 0], flat[:, 0, 1], flat[:, 1, 1]
    ea, eb, ec = flat_error[:, 0, 0], flat_error[:, 0, 1], flat_error[:, 1, 1]
    det = a * c - b * b
    det_error = ea * c + ec * a + 2 * abs(b) * eb + 3 * EPS * abs(det)
    shown &= (det > 0) & np.isfinite(np.stack([a, c, det]).astype(np.float32)).all(axis=0)
    factor, factor_error = np.ones(len(depth)), np.zeros(len(depth))
    if antialiased:
        rows = to_pixels @ matrix
        # The factor that is kept instead of the covariance mixes the columns: errors are those of whole rows.
        rows_error = np.linalg.norm(to_pixels_error @ abs(matrix) + absolute @ matrix_error, axis=2)
        rows_error += 24 * EPS * np.linalg.norm(absolute @ abs(matrix), axis=2)
        length = np.linalg.norm(rows, axis=2)
        area = np.linalg.norm(np.cross(rows[:, 0], rows[:, 1]), axis=1)
        area_error = length[:, 0] * rows_error[:, 1] + length[:, 1] * rows_error[:, 0] + rows_error.prod(axis=1)
        area_error += 5 * EPS * length.prod(axis=1)
        factor = area / np.sqrt(det)
        det_error = np.minimum(det_error, 2 * area * area_error + 0.3 * (ea + ec) + 4 * EPS * det)
        factor_error = area_error / area + det_error / (2 * det) + 2 * EPS
    conic = np.stack([c, -b, a], axis=1) / det[:, None]
    conic_error = np.stack([ec, eb, ea], axis=1) / det[:, None] + abs(conic) * (det_error / det + 3 * EPS)[:, None]

    colour, colour_error = _colours(arrays, degree, world - camera.center, abs(world) + abs(camera.center))
    opacity_error = EXP2_ERROR + 4 * EPS * (1 + abs(logit))
    if antialiased:
        opacity_error = opacity_error + factor_error + math.log(2) * (LOG2_ERROR + 2 * EPS * abs(np.log2(factor)))
    return _Splats(
        shown,
        depth.astype(np.float32),
        slope * focal + centre,
        slope_error * focal + 2 * EPS * (abs(slope * focal) + abs(centre)),
        flat,
        conic,
        conic_error,
        opacity * factor,
        opacity_error + EXP2_ERROR + math.log(2) * (LOG2_ERROR + 2 * EPS * abs(np.log2(opacity))),
        colour,
        colour_error,
    )


def _colours(
    arrays: dict[str, np.ndarray], degree: int, ray: np.ndarray, terms: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """[N, 3] colours, and [N] bounds on their errors."""
    count = (degree + 1) ** 2 - 1
    length = np.linalg.norm(ray, axis=1)
    basis = sh_basis(degree, ray / length[:, None])
    rest = arrays["sh_rest"].reshape(3, count, len(ray))
    colour = basis[0] * arrays["sh_dc"] + np.einsum("kn,ckn->cn", basis[1:], rest) + 0.5
    turn_error = 3 * EPS * terms.sum(axis=1) / length + 6 * EPS
    order = np.floor(np.sqrt(np.arange(1, count + 1)))[:, None]
    # A basis function of degree l is at most 1.5 l here and changes by at most l times that with the direction.
    term_error = 1.5 * order * (order * turn_error + (12 + count) * EPS)
    error = np.einsum("kn,ckn->cn", np.broadcast_to(term_error, basis[1:].shape), abs(rest)).max(axis=0, initial=0.0)
    return np.maximum(colour, 0).T, error + 4 * EPS * (1 + abs(arrays["sh_dc"]).max(axis=0))


def alphas(splats: _Splats, k: int, xs: np.ndarray, ys: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """[H, W] alpha of a splat, the bound on its error, and where it is held at its cap."""
    dx, dy = xs - splats.mean[k, 0], ys - splats.mean[k, 1]
    (ca, cb, cc), (ea, eb, ec) = splats.conic[k], splats.conic_error[k]
    q = np.maximum(ca * dx * dx + 2 * cb * dx * dy + cc * dy * dy, 0)
    parts = ca * dx * dx + 2 * abs(cb * dx * dy) + cc * dy * dy
    exponent_error = (ea * dx * dx + 2 * eb * abs(dx * dy) + ec * dy * dy) / 2 + 5 * EPS * parts
    exponent_error += abs(ca * dx + cb * dy) * splats.mean_error[k, 0]
    exponent_error += abs(cb * dx + cc * dy) * splats.mean_error[k, 1]
    # The level is added to what the pixel's row decides before the rest is: one rounding of each.
    exponent_error += splats.exponent_error[k] + 2 * EPS * q + EPS * abs(np.log(splats.opacity[k]))
    full = splats.opacity[k] * np.exp(-q / 2)
    error = np.where(full * (1 - exponent_error) > ALPHA_MAX, EPS, full * exponent_error)
    return np.minimum(ALPHA_MAX, full), error, full >= ALPHA_MAX


def render(
    source: SceneSource,
    camera: Camera,
    near: float = 0.2,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    stop: float = STOP,
    antialiased: bool = False,
) -> Reference:
    """Render `source` from `camera` (both in world coordinates)."""
    stored = source.read(slice(0, source.count), list(FIELD))
    arrays = {name: plane.astype(np.float64) for name, plane in stored.items()}
    with np.errstate(all="ignore"):  # behind the camera and at infinity values are nonsense, and culled
        splats = _project(arrays, source.sh_degree, camera.moved(source.origin), near, antialiased)
    height, width, count = camera.height, camera.width, source.count
    xs, ys = np.arange(width)[None, :], np.arange(height)[:, None]
    image, trans = np.zeros((height, width, 3)), np.ones((height, width))
    bound, trans_error = np.zeros((height, width)), np.zeros((height, width))
    alive = np.ones((height, width), bool)
    fragile = np.zeros((height, width), bool)
    hits, unsure = np.zeros((2, count), np.int64)
    weights, weight_bound, weights2, removal = np.zeros((4, count))
    blended: list[tuple[int, np.ndarray, np.ndarray, np.ndarray]] = []

    for k in np.argsort(splats.depth, kind="stable"):
        if not splats.shown[k]:
            continue
        if not (alive | fragile).any():
            break
        alpha, alpha_error, _ = alphas(splats, k, xs, ys)

        seen = alive & (alpha >= ALPHA_MIN)
        after = trans * (1 - alpha)
        after_error = trans_error * (1 - alpha) + trans * alpha_error + 2 * EPS * after
        near_stop = seen & (abs(after - stop) <= after_error)
        fragile |= alive & (abs(alpha - ALPHA_MIN) <= alpha_error) | near_stop
        hit = seen & (after >= stop)
        # A pixel whose end is on the edge may go on in float32 where it stops here.
        possible = fragile & (alpha + alpha_error >= ALPHA_MIN)
        weight = np.where(hit, alpha * trans, 0.0)
        weight_error = np.where(hit, alpha * trans_error + trans * alpha_error + EPS * weight, 0.0)
        if hit.any():
            blended.append((k, hit, alpha, weight))
        image += weight[..., None] * splats.colour[k]
        bound += weight_error * splats.colour[k].max() + weight * splats.colour_error[k] + EPS * image.max(axis=2)
        hits[k], unsure[k] = hit.sum(), possible.sum()
        weights[k], weights2[k] = weight.sum(), np.square(weight).sum()
        weight_bound[k] = weight_error.sum() + 16 * EPS * weights[k] + possible.sum() + hit.any() * 64 * 2.0**-32
        trans, trans_error = np.where(hit, after, trans), np.where(hit, after_error, trans_error)
        alive &= ~(seen & ~hit)

    shade = np.array(background, np.float64)
    image += trans[..., None] * shade
    bound += trans_error * shade.max() + 2 * EPS * image.max(axis=2)
    passed = np.zeros((height, width, 3))
    for k, hit, alpha, weight in blended:
        passed += weight[..., None] * splats.colour[k]
        behind = np.where(hit, alpha / (1 - alpha), 0.0)[..., None] * (image - passed)
        removal[k] = np.square(weight[..., None] * splats.colour[k] - behind).sum()
    return Reference(image, bound, fragile, hits, unsure, weights, weight_bound, splats.shown, weights2, removal)
