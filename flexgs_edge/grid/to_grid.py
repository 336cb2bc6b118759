"""Quantize a scene to grid codes: sort it along the Morton curve, and round each value to its step size."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flexgs_edge.constants import CODE_LIMIT, MAX_SH_DEGREE
from flexgs_edge.errors import InputError
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.grid.step_sizes import POSITION_BITS, Planes, StepSizes
from flexgs_edge.memory.rows import blocks, put_rows, read_ahead, read_rows
from flexgs_edge.memory.storage import IN_MEMORY, OrderedPlanes, Storage, stable_order
from flexgs_edge.scene.curve import morton
from flexgs_edge.scene.fields import sh_rest_count
from flexgs_edge.scene.rotations import canonical_axes


def to_grid(
    planes: Planes,  # {field: [width, n] f32}, finite; `means` relative to `origin`
    sh_degrees: np.ndarray,  # [n], the SH degree to keep for each row; higher coefficients are left out
    steps: StepSizes,  # needs one SH step for each degree kept
    origin: np.ndarray | Sequence[float],  # [3] f64
    layer: np.ndarray | None = None,  # [n], 0 to 255
    storage: Storage = IN_MEMORY,  # holds the grid
) -> tuple[GridScene, np.ndarray]:
    """Put a scene on a grid.

    A Gaussian has 24 equal forms, since its axes can be permuted and reversed. We write the form with the
    smallest rotation, which needs the fewest bits.

    Returns the `GridScene`, and [n] i64: the input row of each of its rows. Raises `InputError` if a value is not
    finite, or its code is out of range; nothing is clipped.
    """
    count = planes["means"].shape[1]
    degrees = _bytes("sh_degrees", sh_degrees, count, MAX_SH_DEGREE)
    top = int(degrees.max(initial=0))
    if len(steps.sh) < top or planes["sh_rest"].shape[0] < 3 * sh_rest_count(top):
        raise InputError(f"SH degree {top} asked for: expected a step and coefficients for each degree up to it")
    position, order = _along_curve(planes["means"], steps, layer, storage)
    scale, rotation, dc = (storage.empty((3, count), np.int32) for _ in range(3))
    opacity = storage.empty((count,), np.int32)
    ordered = OrderedPlanes(planes, order, storage)
    for part, values in ordered.parts(count, "quats", "log_scales", "opacity_logits", "sh_dc"):
        rows, (quats, log_scales, logits, colours) = order[part], values
        quats, log_scales = canonical_axes(quats, log_scales)
        put_rows(scale, part, _codes("log_scales", log_scales, steps.scale, rows))
        put_rows(rotation, part, _codes("quats", quats[1:], steps.rotation, rows))
        put_rows(opacity, part, _codes("opacity_logits", logits, steps.opacity, rows)[0])
        put_rows(dc, part, _colour_codes("sh_dc", colours[:, None], steps.colour(steps.dc), rows)[:, 0])
    degrees = degrees[order]
    grid = GridScene(
        count,
        top,
        np.array(origin, np.float64).reshape(3),
        replace(steps, sh=steps.sh[:top]),
        position,
        scale,
        rotation,
        opacity,
        dc,
        degrees,
        tuple(
            _band_codes(ordered, degree, np.flatnonzero(degrees >= degree), steps, storage, order)
            for degree in range(1, top + 1)
        ),
        np.zeros(count, np.uint8) if layer is None else _bytes("layer", layer, count, 255)[order],
    )
    return grid, order


def _along_curve(
    means: np.ndarray, steps: StepSizes, layer: np.ndarray | None, storage: Storage
) -> tuple[np.ndarray, np.ndarray]:
    """Position codes [3, n] i32 in their new order, and that order [n] i64: by layer, then along the Morton curve."""
    count = means.shape[1]
    codes = storage.empty((3, count), np.int32)
    low, high = np.full((3, 1), CODE_LIMIT), np.full((3, 1), -CODE_LIMIT)
    for part, (values,) in read_ahead(count, means):
        values = values if steps.contraction is None else steps.contraction.contract(values)
        some = _codes("means", values, steps.position, np.arange(part.start, part.stop))
        put_rows(codes, part, some)
        low, high = (
            np.minimum(low, some.min(axis=1, keepdims=True)),
            np.maximum(high, some.max(axis=1, keepdims=True)),
        )
    if count and (high - low).max() >= 1 << POSITION_BITS:
        raise InputError(
            f"means: the scene is {int((high - low).max())} position steps of {steps.position:g} wide, expected less than "
            f"2^{POSITION_BITS}: take a larger step or remove far outliers"
        )
    keys = storage.empty((count,), np.uint64)
    for part, (some,) in read_ahead(count, codes):
        put_rows(keys, part, morton(some - low))
    layers = None if layer is None else _bytes("layer", layer, count, 255)
    order = stable_order(keys, storage) if layers is None else np.lexsort((keys, layers)).astype(np.int64)
    return storage.take(codes, order), order


def lowered(grid: GridScene, storage: Storage = IN_MEMORY) -> GridScene:
    """Lower the SH degree of each row as far as its codes are zero; the values stay the same, and zeros are not stored."""
    degrees, bands = grid.sh_degrees.copy(), list(grid.sh)
    for degree in range(grid.sh_degree, 0, -1):
        codes = grid.sh[degree - 1]
        rows = np.flatnonzero(grid.sh_degrees >= degree)
        zero = np.empty(len(rows), bool)
        for part in blocks(len(rows)):
            zero[part] = ~read_rows(codes, part).any(axis=0)
        # A row with a higher degree also needs this one.
        zero &= degrees[rows] == degree
        degrees[rows[zero]] = degree - 1
        if zero.any():
            bands[degree - 1] = storage.take(codes, np.flatnonzero(~zero))
    top = int(degrees.max(initial=0))
    return replace(
        grid,
        sh_degree=top,
        step_sizes=replace(grid.step_sizes, sh=grid.step_sizes.sh[:top]),
        sh_degrees=degrees,
        sh=tuple(bands[:top]),
    )


def recolour(
    grid: GridScene, sh_dc: np.ndarray, sh_rest: np.ndarray | None = None, storage: Storage = IN_MEMORY
) -> GridScene:
    """Replace the colours of a scene: [3, n] and [3 * K, n] f32 in the grid's row order, on the same steps.

    Without `sh_rest`, the codes above degree 0 stay.
    """
    dc = storage.empty((3, grid.count), np.int32)
    for part in blocks(grid.count):
        rows, some = np.arange(part.start, part.stop), read_rows(sh_dc, part)[:, None]
        put_rows(dc, part, _colour_codes("sh_dc", some, grid.step_sizes.colour(grid.step_sizes.dc), rows)[:, 0])
    if sh_rest is None:
        return replace(grid, dc=dc)
    degrees = range(1, grid.sh_degree + 1)
    colours = OrderedPlanes({"sh_rest": sh_rest}, None, storage)
    bands = tuple(
        _band_codes(colours, d, np.flatnonzero(grid.sh_degrees >= d), grid.step_sizes, storage) for d in degrees
    )
    return replace(grid, dc=dc, sh=bands)


def _bytes(name: str, values: np.ndarray, count: int, highest: int) -> np.ndarray:
    values = np.asarray(values)
    if values.shape != (count,):
        raise InputError(f"{name}: expected {count} rows, got an array of shape {values.shape}")
    bad = np.flatnonzero((values < 0) | (values > highest))
    if len(bad):
        raise InputError(f"{name}: row {bad[0]}: expected 0 to {highest}, got {values[bad[0]]}")
    return values.astype(np.uint8)


def _codes(name: str, values: np.ndarray, step: float | np.ndarray, order: np.ndarray | None = None) -> np.ndarray:
    """rint(value / step) in float64, as i32; `order` gives the input rows for error messages."""
    codes = np.rint(np.asarray(values, np.float64) / step)
    bad = ~(np.abs(codes) <= CODE_LIMIT)  # NaN compares false
    if bad.any():
        *_, at = place = tuple(np.argwhere(bad)[0])
        row = at if order is None else order[at]
        raise InputError(
            f"{name}: row {row}: value {np.asarray(values)[place]:g} at a step of {np.broadcast_to(step, codes.shape)[place]:g}:"
            f" expected a finite number of at most 2^24 steps"
        )
    return codes.astype(np.int32)


def _colour_codes(name: str, rgb: np.ndarray, steps: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Codes of Y = (R + 2G + B) / 4, Co = R - B, Cg = (2G - R - B) / 2, from [3, m, n] values."""
    red, green, blue = np.asarray(rgb, np.float64)
    both = red + blue
    colour = np.stack([(both + 2 * green) / 4, red - blue, (2 * green - both) / 2])
    return _codes(name, colour, steps[:, None, None].astype(np.float64), order)


def _band_codes(
    planes: OrderedPlanes,
    degree: int,
    rows: np.ndarray,
    steps: StepSizes,
    storage: Storage,
    order: np.ndarray | None = None,
) -> np.ndarray:
    """[3 * (2l + 1), n] codes of the coefficients of one SH degree l. `order` gives the input rows for error messages."""
    codes = storage.empty((3, 2 * degree + 1, len(rows)), np.int32)
    for part in blocks(len(rows)):
        chosen = rows[part]
        named = chosen if order is None else order[chosen]
        rgb = planes.band(degree, chosen)
        put_rows(codes, part, _colour_codes("sh_rest", rgb, steps.colour(steps.sh[degree - 1]), named))
    return codes.reshape(6 * degree + 3, len(rows))
