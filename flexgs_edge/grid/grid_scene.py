"""A scene in integer codes, which a container codes, and the values that every decoder makes of them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.memory.rows import put_rows, read_ahead, read_rows
from flexgs_edge.memory.storage import IN_MEMORY, Storage
from flexgs_edge.scene.fields import FIELD, sh_rest_count

CODES = ("position", "scale", "rotation", "opacity", "dc")  # Arrays with a column for each row of a scene


@dataclass(frozen=True, eq=False)
class GridScene:
    """A scene in integer codes. Rows are sorted by layer, then along the Morton curve of their position cells."""

    count: int  # rows n
    sh_degree: int  # D; 0 if no row has SH
    origin: np.ndarray  # [3] f64, world: positions are relative to it
    step_sizes: StepSizes  # a value is its code times the step size
    position: np.ndarray  # [3, n] i32
    scale: np.ndarray  # [3, n] i32
    rotation: np.ndarray  # [3, n] i32: x, y, z of the unit quaternion, which has w >= 0 and no component larger than w
    opacity: np.ndarray  # [n] i32
    dc: np.ndarray  # [3, n] i32: Y, Co, Cg
    sh_degrees: np.ndarray  # [n] u8, 0 to D
    # For each degree l from 1 to D: [3 * (2l + 1), rows with a degree >= l] i32: all Y, all Co, all Cg.
    sh: tuple[np.ndarray, ...]
    layer: np.ndarray  # [n] u8, ascending; all 0 if there are no layers

    @property
    def sh_count(self) -> int:
        """Number of rows with SH above degree 0."""
        return int(np.count_nonzero(self.sh_degrees))

    def take(self, rows: np.ndarray, storage: Storage = IN_MEMORY) -> "GridScene":
        """A new scene of the given rows, in their order, with the highest SH degree that is left."""
        rows = np.arange(self.count)[rows]
        degrees = self.sh_degrees[rows]
        top = int(degrees.max(initial=0))
        bands = tuple(storage.take(self.sh[d], row_places(self.sh_degrees, rows, d + 1)) for d in range(top))
        steps = replace(self.step_sizes, sh=self.step_sizes.sh[:top])
        codes: dict[str, Any] = {name: storage.take(getattr(self, name), rows) for name in CODES}
        changed: dict[str, Any] = {
            "count": len(rows),
            "sh_degree": top,
            "step_sizes": steps,
            "sh_degrees": degrees,
            "sh": bands,
        }
        return replace(self, layer=self.layer[rows], **changed, **codes)


def row_places(degrees: np.ndarray, rows: np.ndarray, degree: int) -> np.ndarray:
    """Columns of some rows in the SH arrays of a degree; rows below that degree have none."""
    places = np.cumsum(degrees >= degree) - 1
    return places[rows[degrees[rows] >= degree]]


def values_of(grid: GridScene, storage: Storage = IN_MEMORY) -> dict[str, np.ndarray]:
    """Values of all rows and fields (see `from_grid`), in arrays of `storage`."""
    planes = {
        name: storage.empty((field.width(grid.sh_degree), grid.count), np.float32) for name, field in FIELD.items()
    }
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
        # The same places as in `from_grid`, but counted once.
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
    """Values of some rows of a grid; this is the specification of every decoder.

    All operations are float32, each is rounded once, and none is fused. A value is code * step. Quaternions have
    w = sqrt(max(0, 1 - ((x*x + y*y) + z*z))). Colours take h = Cg * 0.5, c = Co * 0.5, t = Y - h, and then
    red = t + c, green = Y + h, blue = t - c. Positions are then expanded, if they are contracted (`Contraction`).

    Returns {field: [width, n] f32}; SH above a row's degree are zero.
    """
    steps = grid.step_sizes
    makers = {
        "means": lambda: _means(_part(grid.position, rows), steps),
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
    """[3 * K, n] f32, zero above each row's SH degree."""
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
            bands.append(grid.sh[degree - 1][:, row_places(grid.sh_degrees, np.arange(grid.count)[rows], degree)])
    return _spread_bands(grid, degrees, bands)


def _spread_bands(grid: GridScene, degrees: np.ndarray, bands: Sequence[np.ndarray]) -> np.ndarray:
    """[3 * K, n] f32 of rows with these SH degrees [n], from the codes of each degree."""
    planes = np.zeros((3, sh_rest_count(grid.sh_degree), len(degrees)), np.float32)
    for degree, chosen in enumerate(bands, start=1):
        has = np.flatnonzero(degrees >= degree)
        values = _rgb(
            chosen.reshape(3, 2 * degree + 1, len(has)), grid.step_sizes.colour(grid.step_sizes.sh[degree - 1])
        )
        band = planes[:, degree * degree - 1 : (degree + 1) ** 2 - 1]
        for colour, coefficients in zip(band, values, strict=True):
            # Plane by plane: indexing all planes at once with one list of places is much slower.
            for plane, value in zip(colour, coefficients, strict=True):
                plane[has] = value
    return planes.reshape(planes.shape[0] * planes.shape[1], len(degrees))


def _values(codes: np.ndarray, step: float) -> np.ndarray:
    return codes.astype(np.float32) * np.float32(step)


def _means(codes: np.ndarray, steps: StepSizes) -> np.ndarray:
    means = _values(codes, steps.position)
    return means if steps.contraction is None else steps.contraction.expand(means)


def _quats(xyz: np.ndarray) -> np.ndarray:
    """[4, n] f32 quaternions w x y z, from their last three components."""
    x, y, z = xyz
    square = np.float32(1) - ((x * x + y * y) + z * z)
    return np.stack([np.sqrt(np.maximum(square, np.float32(0))), x, y, z])


def _rgb(codes: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """[3, m, n] f32 red, green and blue, from codes of Y, Co, Cg."""
    luma, orange, green = codes.astype(np.float32) * steps[:, None, None]
    half_orange, half_green = orange * np.float32(0.5), green * np.float32(0.5)
    rest = luma - half_green
    return np.stack([rest + half_orange, luma + half_green, rest - half_orange])
