"""Scene values on integer grids: one step a kind of value, rows along a space-filling curve.

What the real coder stores (docs/format.md, version 2). Steps halve or double as a search asks, so that every kind of
value loses the same for its last bit. Going back to values takes IEEE basic operations in a written order only, so every
machine gets the same bits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from flexgs_edge.constants import CODE_LIMIT, MAX_SH_DEGREE
from flexgs_edge.curve import morton
from flexgs_edge.errors import InputError
from flexgs_edge.mapped import blocks, put_rows, read_ahead, read_rows
from flexgs_edge.ordered import OrderedPlanes
from flexgs_edge.rotations import canonical_axes
from flexgs_edge.scene.fields import FIELD, sh_rest_count
from flexgs_edge.scratch import MEMORY, Room, stable_order

POSITION_BITS = 21
"""Cells along an axis of a scene as a power of two: three of them fill a 63-bit curve index."""

Planes = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Steps:
    """Grid steps, rounded to float32 once.

    Parameters
    ----------
    position : float
        Scene units.
    scale : float
        Natural logarithm.
    rotation : float
        Component x, y or z of a unit quaternion.
    opacity : float
        Logit.
    dc : float
        Luma of the SH coefficient of degree 0.
    sh : tuple of float
        Luma of SH coefficients, one step for each degree from 1.
    chroma : float, optional
        Factor of the steps of the two chroma planes.
    """

    position: float
    scale: float
    rotation: float
    opacity: float
    dc: float
    sh: tuple[float, ...] = ()
    chroma: float = 1.5

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            numbers = value if name == "sh" else (value,)
            with np.errstate(over="ignore"):  # a file may say 1e300
                rounded = tuple(float(np.float32(number)) for number in numbers)
            # Beyond this, codes of 24 bits times a step times the chroma factor leave float32's normal numbers.
            most = 16 if name == "chroma" else 80
            if not all(2.0**-most <= number <= 2.0**most for number in rounded):
                raise InputError(f"step of {name}: expected positive numbers from 2^-{most} to 2^{most}, got {value}")
            object.__setattr__(self, name, rounded if name == "sh" else rounded[0])
        if len(self.sh) > MAX_SH_DEGREE:
            raise InputError(f"steps of sh: expected at most {MAX_SH_DEGREE}, one a degree, got {len(self.sh)}")

    def to_json(self) -> dict[str, Any]:
        """The fields as JSON values."""
        return {**asdict(self), "sh": list(self.sh)}

    @classmethod
    def from_json(cls, record: Mapping[str, Any]) -> Steps:
        """Inverse of `to_json`."""
        return cls(**{**record, "sh": tuple(record["sh"])})

    def colour(self, luma: float) -> np.ndarray:
        """[3] f32: the steps of Y, Co and Cg for a step of luma."""
        chroma = np.float32(luma) * np.float32(self.chroma)
        return np.array([luma, chroma, chroma], np.float32)


@dataclass(frozen=True, eq=False)
class GridScene:
    """A scene in integers, rows sorted by layer, then along the Morton curve of the position cells.

    Parameters
    ----------
    count : int
        Rows n.
    sh_degree : int
        D; 0 when no row has SH.
    origin : np.ndarray
        [3] f64, world: positions are relative to it.
    steps : Steps
        Value = code * step.
    position : np.ndarray
        [3, n] i32.
    scale : np.ndarray
        [3, n] i32.
    rotation : np.ndarray
        [3, n] i32: x, y, z of the unit quaternion, which has w >= 0 and no component larger than w.
    opacity : np.ndarray
        [n] i32.
    dc : np.ndarray
        [3, n] i32: Y, Co, Cg.
    sh_degrees : np.ndarray
        [n] u8, 0 to D.
    sh : tuple of np.ndarray
        For each degree l from 1 to D: [3 * (2l + 1), rows with a degree >= l] i32: all Y, all Co, all Cg.
    layer : np.ndarray
        [n] u8, ascending; all 0 when there are no layers.
    """

    count: int
    sh_degree: int
    origin: np.ndarray
    steps: Steps
    position: np.ndarray
    scale: np.ndarray
    rotation: np.ndarray
    opacity: np.ndarray
    dc: np.ndarray
    sh_degrees: np.ndarray
    sh: tuple[np.ndarray, ...]
    layer: np.ndarray

    @property
    def sh_count(self) -> int:
        """Rows with SH above degree 0."""
        return int(np.count_nonzero(self.sh_degrees))

    def take(self, rows: np.ndarray, room: Room = MEMORY) -> GridScene:
        """The rows `rows` in their order, with the SH degree that is left."""
        rows = np.arange(self.count)[rows]
        degrees = self.sh_degrees[rows]
        top = int(degrees.max(initial=0))
        bands = tuple(room.take(self.sh[d], _places(self.sh_degrees, rows, d + 1)) for d in range(top))
        return GridScene(
            len(rows),
            top,
            self.origin,
            replace(self.steps, sh=self.steps.sh[:top]),
            room.take(self.position, rows),
            room.take(self.scale, rows),
            room.take(self.rotation, rows),
            room.take(self.opacity, rows),
            room.take(self.dc, rows),
            degrees,
            bands,
            self.layer[rows],
        )


def _places(degrees: np.ndarray, rows: np.ndarray, degree: int) -> np.ndarray:
    """Where the SH of those `rows` that have `degree` lie in the arrays of that degree."""
    places = np.cumsum(degrees >= degree) - 1
    chosen: np.ndarray = places[rows[degrees[rows] >= degree]]
    return chosen


def to_grid(
    planes: Planes,
    sh_degrees: np.ndarray,
    steps: Steps,
    origin: np.ndarray | Sequence[float],
    layer: np.ndarray | None = None,
    room: Room = MEMORY,
    rename: bool = True,
) -> tuple[GridScene, np.ndarray]:
    """Put a scene on its grid.

    Every Gaussian is written in that one of its 24 equal forms (its axes can be renamed and turned round) whose rotation
    is smallest: 1.4 bits less a Gaussian than the form that training left.

    Parameters
    ----------
    planes : mapping
        {field: [width, n] f32}, finite; `means` relative to `origin`.
    sh_degrees : np.ndarray
        [n], the SH degree kept for each row; coefficients above it are left out.
    steps : Steps
        Needs one SH step for each degree kept.
    origin : array_like
        [3] f64.
    layer : np.ndarray, optional
        [n], 0 to 255.
    room : Room, optional
        Where the grid goes.
    rename : bool
        Look for that form; False leaves rotations and scales as they are.

    Returns
    -------
    tuple
        The `GridScene`, and [n] i64: the input row of each of its rows.

    Raises
    ------
    InputError
        When a value is not finite or its code is out of range: nothing is clipped.
    """
    count = planes["means"].shape[1]
    degrees = _bytes("sh_degrees", sh_degrees, count, MAX_SH_DEGREE)
    top = int(degrees.max(initial=0))
    if len(steps.sh) < top or planes["sh_rest"].shape[0] < 3 * sh_rest_count(top):
        raise InputError(f"SH degree {top} asked for: expected a step and coefficients for each degree up to it")
    position, order = _along_curve(planes["means"], steps.position, layer, room)
    scale, rotation, dc = (room.empty((3, count), np.int32) for _ in range(3))
    opacity = room.empty((count,), np.int32)
    ordered = OrderedPlanes(planes, order, room)
    for part, values in ordered.parts(count, "quats", "log_scales", "opacity_logits", "sh_dc"):
        rows, (quats, log_scales, logits, colours) = order[part], values
        if rename:
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
            _band_codes(ordered, degree, np.flatnonzero(degrees >= degree), steps, room, order)
            for degree in range(1, top + 1)
        ),
        np.zeros(count, np.uint8) if layer is None else _bytes("layer", layer, count, 255)[order],
    )
    return grid, order


def _along_curve(means: np.ndarray, step: float, layer: np.ndarray | None, room: Room) -> tuple[np.ndarray, np.ndarray]:
    """Position codes [3, n] i32 in their order, and that order ([n] i64): by layer, then along the Morton curve."""
    count = means.shape[1]
    codes = room.empty((3, count), np.int32)
    low, high = np.full((3, 1), CODE_LIMIT), np.full((3, 1), -CODE_LIMIT)
    for part, (values,) in read_ahead(count, means):
        some = _codes("means", values, step, np.arange(part.start, part.stop))
        put_rows(codes, part, some)
        low, high = (
            np.minimum(low, some.min(axis=1, keepdims=True)),
            np.maximum(high, some.max(axis=1, keepdims=True)),
        )
    if count and (high - low).max() >= 1 << POSITION_BITS:
        raise InputError(
            f"means: the scene is {int((high - low).max())} position steps of {step:g} wide, expected less than "
            f"2^{POSITION_BITS}: take a larger step or remove far outliers"
        )
    keys = room.empty((count,), np.uint64)
    for part, (some,) in read_ahead(count, codes):
        put_rows(keys, part, morton(some - low))
    layers = None if layer is None else _bytes("layer", layer, count, 255)
    order = stable_order(keys, room) if layers is None else np.lexsort((keys, layers)).astype(np.int64)
    return room.take(codes, order), order


def values_of(grid: GridScene, room: Room = MEMORY) -> dict[str, np.ndarray]:
    """`from_grid` of all rows and fields, in arrays of `room`."""
    planes = {name: room.empty((field.width(grid.sh_degree), grid.count), np.float32) for name, field in FIELD.items()}
    names = [name for name in FIELD if name != "sh_rest"]
    first = np.zeros(grid.sh_degree, np.int64)
    for part, found in read_ahead(grid.count, grid.position, grid.scale, grid.rotation, grid.opacity, grid.dc):
        position, scale, rotation, opacity, dc = found
        some = replace(
            grid,
            count=part.stop - part.start,
            position=position,
            scale=scale,
            rotation=rotation,
            opacity=opacity,
            dc=dc,
        )
        for name, values in from_grid(some, slice(None), names).items():
            put_rows(planes[name], part, values)
        # As `from_grid` finds them, but counted once.
        degrees = grid.sh_degrees[part]
        last = first + np.array([np.count_nonzero(degrees > level) for level in range(grid.sh_degree)], np.int64)
        bands = [
            read_rows(band, slice(a, b)) for band, a, b in zip(grid.sh, first.tolist(), last.tolist(), strict=True)
        ]
        put_rows(planes["sh_rest"], part, _spread_bands(grid, degrees, bands))
        first = last
    return planes


def from_grid(
    grid: GridScene, rows: slice | np.ndarray = slice(None), fields: Sequence[str] = tuple(FIELD)
) -> dict[str, np.ndarray]:
    """Values of `rows` of a grid: the specification of every decoder.

    In float32, each operation rounded once and none fused: value = code * step; quaternions
    w = sqrt(max(0, 1 - ((x*x + y*y) + z*z))); colours h = Cg * 0.5, c = Co * 0.5, t = Y - h, then
    red = t + c, green = Y + h, blue = t - c.

    Returns
    -------
    dict
        {field: [width, n] f32}; SH above a row's degree are zero.
    """
    steps = grid.steps
    makers = {
        "means": lambda: _values(_part(grid.position, rows), steps.position),
        "sh_dc": lambda: _rgb(_part(grid.dc, rows)[:, None], steps.colour(steps.dc))[:, 0],
        "sh_rest": lambda: _sh_rest(grid, rows),
        "opacity_logits": lambda: _values(_part(grid.opacity, rows)[None], steps.opacity),
        "log_scales": lambda: _values(_part(grid.scale, rows), steps.scale),
        "quats": lambda: _quats(_values(_part(grid.rotation, rows), steps.rotation)),
    }
    return {field: makers[field]() for field in fields}


def _part(values: np.ndarray, rows: slice | np.ndarray) -> np.ndarray:
    if isinstance(rows, slice) and rows.step in (None, 1):
        return read_rows(values, slice(*rows.indices(values.shape[-1])[:2]))
    return values[..., rows]


def _sh_rest(grid: GridScene, rows: slice | np.ndarray) -> np.ndarray:
    """[3 * K, n] f32, zero above each row's degree."""
    if isinstance(rows, slice):
        start, stop, step = rows.indices(grid.count)
        rows = rows if step == 1 else np.arange(start, stop, step)
    degrees = grid.sh_degrees[rows]
    bands = []
    for degree in range(1, grid.sh_degree + 1):
        if isinstance(rows, slice):
            first = int(np.count_nonzero(grid.sh_degrees[:start] >= degree))
            last = first + int(np.count_nonzero(degrees >= degree))
            bands.append(read_rows(grid.sh[degree - 1], slice(first, last)))
        else:
            bands.append(grid.sh[degree - 1][:, _places(grid.sh_degrees, np.arange(grid.count)[rows], degree)])
    return _spread_bands(grid, degrees, bands)


def _spread_bands(grid: GridScene, degrees: np.ndarray, bands: Sequence[np.ndarray]) -> np.ndarray:
    """[3 * K, n] f32 of rows with these degrees ([n]) and these codes of each degree."""
    planes = np.zeros((3, sh_rest_count(grid.sh_degree), len(degrees)), np.float32)
    for degree, chosen in enumerate(bands, start=1):
        has = np.flatnonzero(degrees >= degree)
        values = _rgb(chosen.reshape(3, 2 * degree + 1, len(has)), grid.steps.colour(grid.steps.sh[degree - 1]))
        band = planes[:, degree * degree - 1 : (degree + 1) ** 2 - 1]
        for colour, coefficients in zip(band, values, strict=True):
            # Plane by plane: one list of places for all of them at once takes five times as long.
            for plane, value in zip(colour, coefficients, strict=True):
                plane[has] = value
    return planes.reshape(planes.shape[0] * planes.shape[1], len(degrees))


def recolour(grid: GridScene, sh_dc: np.ndarray, sh_rest: np.ndarray, room: Room = MEMORY) -> GridScene:
    """The same rows with other colours ([3, n] and [3 * K, n] f32, in the grid's row order) put on the same steps."""
    dc = room.empty((3, grid.count), np.int32)
    for part in blocks(grid.count):
        rows, some = np.arange(part.start, part.stop), read_rows(sh_dc, part)[:, None]
        put_rows(dc, part, _colour_codes("sh_dc", some, grid.steps.colour(grid.steps.dc), rows)[:, 0])
    degrees = range(1, grid.sh_degree + 1)
    colours = OrderedPlanes({"sh_rest": sh_rest}, None, room)
    bands = tuple(_band_codes(colours, d, np.flatnonzero(grid.sh_degrees >= d), grid.steps, room) for d in degrees)
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
    """rint(value / step) in float64 as i32; `order` gives input rows for the message."""
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
    """Codes of Y = (R + 2G + B) / 4, Co = R - B, Cg = (2G - R - B) / 2 of [3, m, n] values."""
    red, green, blue = np.asarray(rgb, np.float64)
    both = red + blue
    colour = np.stack([(both + 2 * green) / 4, red - blue, (2 * green - both) / 2])
    return _codes(name, colour, steps[:, None, None].astype(np.float64), order)


def _band_codes(
    planes: OrderedPlanes, degree: int, rows: np.ndarray, steps: Steps, room: Room, order: np.ndarray | None = None
) -> np.ndarray:
    """[3 * (2l + 1), n] codes of the coefficients of one SH degree; `order` gives input rows for the message."""
    codes = room.empty((3, 2 * degree + 1, len(rows)), np.int32)
    for part in blocks(len(rows)):
        chosen = rows[part]
        named = chosen if order is None else order[chosen]
        rgb = planes.band(degree, chosen)
        put_rows(codes, part, _colour_codes("sh_rest", rgb, steps.colour(steps.sh[degree - 1]), named))
    return codes.reshape(6 * degree + 3, len(rows))


def _values(codes: np.ndarray, step: float) -> np.ndarray:
    values: np.ndarray = codes.astype(np.float32) * np.float32(step)
    return values


def _quats(xyz: np.ndarray) -> np.ndarray:
    """[4, n] f32 quaternions w x y z of their last three components."""
    x, y, z = xyz
    square = np.float32(1) - ((x * x + y * y) + z * z)
    return np.stack([np.sqrt(np.maximum(square, np.float32(0))), x, y, z])


def _rgb(codes: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """[3, m, n] f32 colours of Y, Co, Cg codes."""
    luma, orange, green = codes.astype(np.float32) * steps[:, None, None]
    half_orange, half_green = orange * np.float32(0.5), green * np.float32(0.5)
    rest = luma - half_green
    return np.stack([rest + half_orange, luma + half_green, rest - half_orange])
