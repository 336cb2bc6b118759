"""Make a compressed scene with one channel coarser or gone, and count the bytes that this saves in the file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from flexgs_edge.codec.v1.packed_source import FgsSource, QuantizedSource
from flexgs_edge.codec.v2.container import coded_size
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.grid.values import from_grid
from flexgs_edge.packed.bitpack import pack
from flexgs_edge.packed.quantize import QuantizedArray, QuantizedScene, codes
from flexgs_edge.report.worth_result import DROPPED, ONE_LESS
from flexgs_edge.scene.curve import morton
from flexgs_edge.scene.fields import FIELDS, sh_rest_count
from flexgs_edge.scene.source import MemorySource, SceneSource

IDENTITY = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Lesser:
    """A scene with one channel coarser or gone.

    Parameters
    ----------
    channel : str
        The channel's name, as `info` shows it. `rest from 2` means the SH of degree 2 and higher of a version 1 file.
    change : str
        `one bit less`: values at twice their step size. `dropped`: the SH of this degree and higher are gone. Any other
        dropped channel has its mean in all Gaussians; rotations become the identity. Positions are never dropped.
    make : callable
        Returns the bytes saved and the scene.
    """

    channel: str
    change: str
    make: Callable[[], tuple[int, SceneSource]]


def reduced_scenes(source: FgsSource | GridSource) -> list[Lesser]:
    """List each channel of a file coarser by one bit, and dropped, in the order of `info`."""
    return list(_of_grid(source) if isinstance(source, GridSource) else _of_packed(source.quantized()))


def _of_grid(source: GridSource) -> Iterator[Lesser]:
    """Reduced scenes of a version 2 file. Each is coded again: only the entropy coder knows the bytes saved."""
    grid, header = source.grid(), source.container.header
    size = partial(coded_size, settings=header.settings, chunk_rows=header.chunk_rows)
    # Not the size of the file: a file that was cut still uses the tables of the whole scene.
    before = size(grid)

    def lesser(channel: str, change: str, make: Callable[[], GridScene]) -> Lesser:
        def made() -> tuple[int, SceneSource]:
            found = make()
            return before - size(found), MemorySource(from_grid(found), origin=found.origin)

        return Lesser(channel, change, made)

    yield lesser("position", ONE_LESS, partial(_coarser_positions, grid))
    for name in ("scale", "rotation", "opacity", "dc"):
        yield lesser(name, ONE_LESS, partial(_coarser, grid, name))
        yield lesser(name, DROPPED, partial(_level, grid, name))
    for degree in range(1, grid.sh_degree + 1):
        yield lesser(f"sh {degree}", ONE_LESS, partial(_coarser_sh, grid, degree))
        yield lesser(f"sh {degree}", DROPPED, partial(_without_sh, grid, degree))


def _halved(codes: np.ndarray) -> np.ndarray:
    """Codes at twice the step size. Ties go to the even code, so that the mean does not move."""
    return np.rint(codes / 2).astype(np.int32)


def _coarser_positions(grid: GridScene) -> GridScene:
    cells = _halved(grid.position)
    corner = cells.min(axis=1, keepdims=True, initial=np.iinfo(np.int32).max)
    order = np.lexsort((morton(cells - corner), grid.layer))
    return replace(
        grid.take(order),
        position=cells[:, order],
        step_sizes=replace(grid.step_sizes, position=2 * grid.step_sizes.position),
    )


def _coarser(grid: GridScene, name: str) -> GridScene:
    steps: dict[str, Any] = {name: 2 * getattr(grid.step_sizes, name)}
    values: dict[str, Any] = {name: _halved(getattr(grid, name))}
    return replace(grid, step_sizes=replace(grid.step_sizes, **steps), **values)


def _level(grid: GridScene, name: str) -> GridScene:
    """Give all rows the mean of a channel. Rotations become the identity: their axes differ in order and have no mean."""
    values = getattr(grid, name)
    mean = np.rint(values.mean(axis=-1, keepdims=True)) if grid.count and name != "rotation" else 0
    level: dict[str, Any] = {name: np.broadcast_to(mean, values.shape).astype(np.int32)}
    return replace(grid, **level)


def _coarser_sh(grid: GridScene, degree: int) -> GridScene:
    bands, steps = list(grid.sh), list(grid.step_sizes.sh)
    bands[degree - 1], steps[degree - 1] = _halved(bands[degree - 1]), 2 * steps[degree - 1]
    return replace(grid, sh=tuple(bands), step_sizes=replace(grid.step_sizes, sh=tuple(steps)))


def _without_sh(grid: GridScene, degree: int) -> GridScene:
    left = degree - 1
    return replace(
        grid,
        sh_degree=left,
        sh_degrees=np.minimum(grid.sh_degrees, left).astype(np.uint8),
        sh=grid.sh[:left],
        step_sizes=replace(grid.step_sizes, sh=grid.step_sizes.sh[:left]),
    )


def _of_packed(scene: QuantizedScene) -> Iterator[Lesser]:
    """Reduced scenes of a version 1 file. Sizes of bit-packed arrays follow from their shape, without coding."""

    def lesser(channel: str, change: str, field: str, make: Callable[[], QuantizedArray | None]) -> Lesser:
        def made() -> tuple[int, SceneSource]:
            array, old = make(), scene.arrays[field]
            if array is None:  # no SH at all
                array = QuantizedArray(old.bits, 0, 0, old.low[:0, :0], old.step[:0, :0], old.planes[:0, :0])
                found = replace(scene, sh_count=0, sh_degree=0, arrays={**scene.arrays, field: array})
                return old.nbytes, QuantizedSource(found)
            degree = _degree_of(array.channels) if field == "sh_rest" else scene.sh_degree
            found = replace(scene, sh_degree=degree, arrays={**scene.arrays, field: array})
            # A value that all rows share would take a few bytes of the header, not one bit per row.
            return old.nbytes - (0 if change == DROPPED and field != "sh_rest" else array.nbytes), QuantizedSource(
                found
            )

        return Lesser(channel, change, made)

    for field in FIELDS:
        name, array = field.name, scene.arrays[field.name]
        if not array.channels:
            continue
        if array.bits > 1:
            yield lesser(field.bits, ONE_LESS, name, partial(_coarser_codes, array))
        if name == "sh_rest":
            for degree in range(1, scene.sh_degree + 1):
                word = field.bits if degree == 1 else f"{field.bits} from {degree}"
                yield lesser(word, DROPPED, name, partial(_lower_degree, array, degree - 1))
        elif name != "means":
            yield lesser(field.bits, DROPPED, name, partial(_level_codes, array, name))


def _degree_of(channels: int) -> int:
    return next(degree for degree in range(5) if 3 * sh_rest_count(degree) == channels)


def _coarser_codes(array: QuantizedArray) -> QuantizedArray:
    bits = array.bits - 1
    found = np.minimum(np.rint(codes(array, slice(None)) / 2), 2**bits - 1).astype(np.uint16)
    planes = np.stack([pack(plane, bits) for plane in found])
    return replace(array, bits=bits, step=2 * array.step, planes=planes)


def _level_codes(array: QuantizedArray, name: str) -> QuantizedArray:
    mean: np.ndarray = np.array(IDENTITY, np.float32)
    if name != "quats":
        sizes = np.diff(np.arange(array.groups + 1) * array.count // array.groups)
        found = codes(array, slice(None))
        low, step = (np.repeat(values, sizes, axis=1).astype(np.float64) for values in (array.low, array.step))
        mean = (low + step * found).mean(axis=1).astype(np.float32)
    low = mean[:, None]
    planes = np.stack([pack(np.zeros(array.count, np.uint16), 1)] * array.channels)
    return replace(array, bits=1, low=low, step=np.zeros_like(low), planes=planes)


def _lower_degree(array: QuantizedArray, degree: int) -> QuantizedArray | None:
    """Keep the lower coefficients of each colour. Channels hold all of red, then green, then blue."""
    if degree == 0:
        return None
    rest, kept = array.channels // 3, sh_rest_count(degree)
    chosen = [colour * rest + k for colour in range(3) for k in range(kept)]
    return replace(
        array, channels=len(chosen), low=array.low[chosen], step=array.step[chosen], planes=array.planes[chosen]
    )
