"""Scenes whose values lie on a grid of ours already, and the comment in a PLY that says which."""

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
    """What a PLY says of the grid that its values lie on."""
    return f"{_COMMENT}{json.dumps(steps.to_json())}"


def steps_of(comments: Sequence[str]) -> StepSizes | None:
    """The steps that such a comment holds; None without one that can be read."""
    for words in comments:
        if words.startswith(_COMMENT):
            try:
                with np.errstate(over="ignore"):  # a step beyond float32 is infinite, and refused
                    return StepSizes.from_json(json.loads(words.removeprefix(_COMMENT)))
            # Anybody may have written it: lists a thousand deep, integers beyond floats.
            except (InputError, ValueError, TypeError, LookupError, ArithmeticError, RecursionError):
                return None
    return None


def on_grid(planes: Planes, steps: StepSizes, origin: np.ndarray) -> GridScene | None:
    """The grid that values lie on, if every one of them lies on it to the bit: nothing is lost by taking it.

    Parameters
    ----------
    planes : mapping
        {field: [width, n] f32}, finite.
    steps : StepSizes
        What a comment says: it may be of other values.
    origin : np.ndarray
        [3] f64.
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
        # Coefficients are channel by channel: those of degrees that no row has are zero, and left out.
        if name == "sh_rest":
            given = bands[:, : sh_rest_count(grid.sh_degree), order].reshape(values.shape)
        if not np.array_equal(values, given):
            return None
    return grid


def lowered(grid: GridScene, storage: Storage = IN_MEMORY) -> GridScene:
    """The same values with each row's SH degree as low as its codes allow: what decodes to zero is not in the file.

    So the grid of a file is the one that is found again in the values that it decodes to (`on_grid`), to the byte.
    """
    degrees, bands = grid.sh_degrees.copy(), list(grid.sh)
    for degree in range(grid.sh_degree, 0, -1):
        codes = grid.sh[degree - 1]
        rows = np.flatnonzero(grid.sh_degrees >= degree)
        zero = np.empty(len(rows), bool)
        for part in blocks(len(rows)):
            zero[part] = ~read_rows(codes, part).any(axis=0)
        # A row that keeps a higher degree keeps this one.
        zero &= degrees[rows] == degree
        degrees[rows[zero]] = degree - 1
        if zero.any():
            bands[degree - 1] = storage.take(codes, np.flatnonzero(~zero))
    top = int(degrees.max(initial=0))
    return replace(
        grid,
        sh_degree=top,
        steps=replace(grid.steps, sh=grid.steps.sh[:top]),
        sh_degrees=degrees,
        sh=tuple(bands[:top]),
    )
