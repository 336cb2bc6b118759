"""Find out whether a scene's values lie on a known grid already. A comment in our PLY files names its step sizes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flexgs_edge.constants import MAX_SH_DEGREE
from flexgs_edge.errors import InputError
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.grid.step_sizes import Planes, StepSizes
from flexgs_edge.grid.to_grid import to_grid
from flexgs_edge.grid.values import from_grid
from flexgs_edge.memory.rows import blocks, read_rows
from flexgs_edge.memory.storage import IN_MEMORY, Storage
from flexgs_edge.scene.fields import sh_rest_count

_COMMENT = "flexgs-edge grid "


def grid_comment(steps: StepSizes) -> str:
    """The comment in a PLY that names the grid of its values."""
    return f"{_COMMENT}{json.dumps(steps.to_json())}"


def steps_of(comments: Sequence[str]) -> StepSizes | None:
    """The step sizes in such a comment; None if there is none that can be read."""
    for words in comments:
        if words.startswith(_COMMENT):
            try:
                with np.errstate(over="ignore"):  # a step beyond float32 becomes infinite, and is refused
                    return StepSizes.from_json(json.loads(words.removeprefix(_COMMENT)))
            # Anybody may have written the comment: lists a thousand deep, integers too large for a float.
            except (InputError, ValueError, TypeError, LookupError, ArithmeticError, RecursionError):
                return None
    return None


def on_grid(planes: Planes, steps: StepSizes, origin: np.ndarray) -> GridScene | None:
    """Put values on a grid, but only if each of them lies on it to the bit; the grid then loses nothing.

    `planes`: {field: [width, n] f32}, finite. `steps`: from a comment, which may not belong to these values. `origin`:
    [3] f64. Returns none if a value does not lie on the grid.
    """
    rest = planes["sh_rest"]
    bands = rest.reshape(3, len(rest) // 3, rest.shape[1])
    degrees = np.zeros(rest.shape[1], np.uint8)
    for degree in range(1, MAX_SH_DEGREE + 1):
        degrees[bands[:, degree * degree - 1 : (degree + 1) ** 2 - 1].any(axis=(0, 1))] = degree
    try:
        grid, order = to_grid(planes, degrees, steps, origin, rename=False)
    except InputError:
        return None
    for name, values in from_grid(grid).items():
        given = planes[name][:, order]
        # Coefficients are stored channel by channel. Degrees that no row has are all zero, and left out.
        if name == "sh_rest":
            given = bands[:, : sh_rest_count(grid.sh_degree), order].reshape(values.shape)
        if not np.array_equal(values, given):
            return None
    return grid


def lowered(grid: GridScene, storage: Storage = IN_MEMORY) -> GridScene:
    """Lower the SH degree of each row as far as its codes are zero; the values stay the same, and zeros are not stored.

    The grid of a file then equals, to the byte, the grid that `on_grid` finds in the decoded values.
    """
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
