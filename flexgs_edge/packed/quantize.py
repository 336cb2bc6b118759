"""Mixed-precision quantization (MPQ): b-bit codes per channel, with one range for each group of consecutive rows.

Source: FlexGaussian (ACM MM 2025), section on MPQ. For a group with smallest value lo and largest value hi:

    step = (hi - lo) / (2^bits - 1)        code = rint((x - lo) / step), clipped        x' = lo + code * step

All numbers are stored and computed in float32. x' takes one multiplication and one addition that are never fused, so
that every device gives the same bits.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from flexgs_edge.constants import GROUP_ROWS
from flexgs_edge.errors import InputError
from flexgs_edge.packed.bitpack import PAPER, BitSpec, pack_into, plane_bytes, unpack
from flexgs_edge.scene.contraction import LARGEST, Contraction, densest
from flexgs_edge.scene.fields import FIELD, FIELDS
from flexgs_edge.scene.rotations import normalize_quats
from flexgs_edge.scene.source import SAMPLE_ROWS, SceneSource, some_positions

FINER = 128  # Within the radius of a contraction, steps of 16 bits are this many times shorter than Gaussians are wide
SMALLEST_STEP = 2.0**-126
"""Smallest normal float32. A range with a finer step counts as constant, since devices may flush the step to zero."""
_Read = Callable[[slice, Sequence[str]], dict[str, np.ndarray]]
"""Reads {field: [c, n] f32} for a range of rows and some fields."""


def group_count(rows: int, groups: int | None = None) -> int:
    """Number of groups for `rows` rows: `groups`, or by default about one for 512 rows; never more than rows.

    >>> group_count(0), group_count(5), group_count(2048), group_count(3, 10)
    (0, 1, 4, 3)
    """
    if groups is not None and groups < 1:
        raise InputError(f"groups: expected at least 1, got {groups}")
    return min(rows, max(1, round(rows / GROUP_ROWS)) if groups is None else groups)


def group_bounds(rows: int, groups: int, first: int = 0, last: int | None = None) -> np.ndarray:
    """First rows of groups `first` to `last` (inclusive; `groups` stands for the end): i * rows // groups as i64."""
    index = np.arange(first, (groups if last is None else last) + 1, dtype=np.int64)
    return index * rows // max(groups, 1)


def group_of(row: int, rows: int, groups: int) -> int:
    """Index of the group that holds `row`: the largest i with i * rows // groups <= row."""
    return ((row + 1) * groups - 1) // rows


@dataclass(frozen=True, eq=False)
class QuantizedArray:
    """The bit-packed codes of one field, and the range of each group. `low`, `step`: [channels, G] f32."""

    bits: int  # bits per code, 1 to 16
    count: int  # rows
    channels: int  # channels (planes)
    low: np.ndarray
    step: np.ndarray
    # [channels, ceil(count * bits / 8)] u8; the code of row i starts at bit i * bits of its plane, least significant bit first.
    planes: np.ndarray

    @property
    def groups(self) -> int:
        """Number of groups."""
        return int(self.low.shape[1])

    @property
    def nbytes(self) -> int:
        """Bytes of the ranges and codes."""
        return self.low.nbytes + self.step.nbytes + self.planes.nbytes


@dataclass(frozen=True, eq=False)
class QuantizedScene:
    """A quantized scene; rows [0, sh_count) have SH, the others have none. `count`, `sh_count`: rows, and rows with SH."""

    count: int
    sh_count: int
    sh_degree: int  # 0 if no row has SH
    origin: np.ndarray  # [3] f64, world: positions are relative to it
    # One `QuantizedArray` for each scene field; `sh_rest` has `sh_count` rows, the others have `count`.
    arrays: dict[str, QuantizedArray]
    # Of the positions that the codes stand for. Default: they are not contracted.
    contraction: Contraction | None = None

    @property
    def bits(self) -> BitSpec:
        """Bits per code of every attribute."""
        return BitSpec(**{FIELD[name].bits: array.bits for name, array in self.arrays.items()})


def array_bytes(rows: int, channels: int, bits: int, groups: int) -> int:
    """Exact bytes of a `QuantizedArray`: its codes, and a range of 8 bytes for each group and channel."""
    return channels * (plane_bytes(rows, bits) + 8 * groups)


def quantized_bytes(count: int, sh_count: int, sh_degree: int, bits: BitSpec, groups: int | None = None) -> int:
    """Exact bytes of the codes and ranges of a `QuantizedScene`, without the container around them."""
    total = 0
    for field in FIELDS:
        rows = sh_count if field.name == "sh_rest" else count
        total += array_bytes(rows, field.width(sh_degree), bits.of(field.name), group_count(rows, groups))
    return total


def dequantize(array: QuantizedArray, rows: slice, first: int = 0, out: np.ndarray | None = None) -> np.ndarray:
    """Values of `rows` (a slice with step 1); this is the specification of every dequantizer.

    `first`: the row at which the planes of the array start, a multiple of 8; its ranges cover all rows. Fills `out` if it is
    given. Returns [c, n] f32, lo + code * step: first the product is rounded to float32, then the sum.
    """
    start, stop, _ = rows.indices(array.count)
    if out is None:
        out = np.empty((array.channels, max(stop - start, 0)), np.float32)
    if out.size == 0:
        return out
    groups, sizes = _groups_of_rows(start, stop, array.count, array.groups)
    for channel in range(array.channels):
        value = out[channel]
        value[:] = unpack(array.planes[channel], array.bits, start - first, stop - first)
        value *= np.repeat(array.step[channel, groups], sizes)
        value += np.repeat(array.low[channel, groups], sizes)
    return out


def quantize_scene(
    source: SceneSource,  # a checked scene (finite values, no zero quaternions)
    rows_with_sh: np.ndarray,
    rows_without_sh: np.ndarray,
    bits: BitSpec = PAPER,  # bits per code
    groups: int | None = None,
    chunk_rows: int = 65536,  # rows held in memory at a time, beside the packed result
    contraction: Contraction | None = None,
) -> QuantizedScene:
    """Quantize the chosen rows of a scene; the result does not depend on `chunk_rows`.

    `rows_with_sh`, `rows_without_sh`: [n] i64 ascending, from `select_rows`, stored in this order. At SH degree 0, no row
    counts as one with SH. `groups`: groups per channel of every array; by default about one for 512 rows. 1 is plain round to
    nearest. `contraction`: from `far_contraction`. Rows are then stored by distance, so that few groups hold near and far ones.
    """
    if source.sh_degree == 0 and len(rows_with_sh):
        rows_without_sh = np.sort(np.concatenate([rows_with_sh, rows_without_sh]))
        rows_with_sh = rows_with_sh[:0]
    count, sh_count = len(rows_with_sh) + len(rows_without_sh), len(rows_with_sh)
    degree = source.sh_degree if sh_count else 0
    blocks = [rows_with_sh, rows_without_sh]
    if contraction is not None:
        with_sh, without_sh = (_by_distance(source, rows, contraction, chunk_rows) for rows in blocks)
        blocks = [*with_sh[::-1], *without_sh]
    layouts = {field.name: (field.width(degree), bits.of(field.name)) for field in FIELDS}  # channels and bits
    rest = {"sh_rest": layouts.pop("sh_rest")}

    def read(part: slice, names: Sequence[str]) -> dict[str, np.ndarray]:
        planes = _read_blocks(source, blocks, part, names)
        if "quats" in planes:
            planes["quats"] = normalize_quats(planes["quats"])
        if "means" in planes and contraction is not None:
            planes["means"] = contraction.contract(planes["means"]).astype(np.float32)
        return planes

    try:
        arrays = _quantize_stream(read, layouts, count, group_count(count, groups), chunk_rows)
        arrays |= _quantize_stream(read, rest, sh_count, group_count(sh_count, groups), chunk_rows)
    except InputError as error:
        raise InputError(f"{source.name}: {error}") from None
    arrays = {field.name: arrays[field.name] for field in FIELDS}
    return QuantizedScene(count, sh_count, degree, np.array(source.origin, np.float64), arrays, contraction)


def far_contraction(source: SceneSource, chunk_rows: int = 65536) -> Contraction | None:
    """The contraction of a scene whose far Gaussians would take the precision of the others; None if it needs none.

    It needs one if a step of 16 bits over the whole scene is longer than half of its Gaussians are wide (their middle axis). The
    radius is the longest at which steps are `FINER` times shorter than that.

    `source`: a checked scene. `chunk_rows`: rows held in memory at a time.
    """
    low, high, widths, every = np.full(3, np.inf), np.full(3, -np.inf), [], max(source.count // SAMPLE_ROWS, 1)
    for rows in source.chunks(chunk_rows):
        planes = source.read(rows, ["means", "log_scales"])
        low, high = np.minimum(low, planes["means"].min(axis=1)), np.maximum(high, planes["means"].max(axis=1))
        widths.append(np.median(planes["log_scales"][:, -rows.start % every :: every], axis=0))
    reach = 65535 * float(np.exp(np.median(np.concatenate(widths).astype(np.float64))))
    if not (high - low).max() > reach:
        return None
    x, y, z = densest(some_positions(source) - source.origin[:, None]).tolist()
    return Contraction((x, y, z), min(max(reach / (2 * FINER), 1 / LARGEST), LARGEST))


def _by_distance(source: SceneSource, rows: np.ndarray, contraction: Contraction, chunk_rows: int) -> list[np.ndarray]:
    """Split ascending rows by octaves of their distance from the centre, near ones first."""
    octaves = np.empty(len(rows), np.int64)
    for start in range(0, len(rows), chunk_rows):
        part = slice(start, start + chunk_rows)
        octaves[part] = contraction.octaves(source.read(rows[part], ["means"])["means"])
    return [rows[octaves == octave] for octave in np.unique(octaves)]


def _read_blocks(
    source: SceneSource, blocks: Sequence[np.ndarray], part: slice, fields: Sequence[str]
) -> dict[str, np.ndarray]:
    """{field: [c, n] f32} of rows `part` of the joined blocks; each block is read as sorted rows."""
    pieces = []
    start, stop = part.start, part.stop
    for block in blocks:
        rows = block[max(start, 0) : max(stop, 0)]
        if len(rows):
            pieces.append(source.read(rows, fields))
        start, stop = start - len(block), stop - len(block)
    if len(pieces) == 1:
        return pieces[0]
    return {field: np.concatenate([piece[field] for piece in pieces], axis=1) for field in fields}


def _quantize_stream(
    read: _Read, layouts: dict[str, tuple[int, int]], rows: int, groups: int, chunk_rows: int
) -> dict[str, QuantizedArray]:
    """Quantize the rows that `read` gives, in runs of whole groups of at most `chunk_rows` rows.

    A larger group is read twice, in pieces: once for its range, once for its codes. `layouts` has the channels and bits
    of every field.
    """
    arrays = {name: _empty_array(rows, channels, bits, groups) for name, (channels, bits) in layouts.items()}
    names = [name for name, array in arrays.items() if array.channels]
    first = 0 if names else groups
    while first < groups:
        start = first * rows // groups
        # Group i ends at or before row start + chunk_rows while i * rows // groups <= start + chunk_rows.
        last = min(max(((start + chunk_rows + 1) * groups - 1) // rows, first + 1), groups)
        stop = last * rows // groups
        pieces = [slice(at, min(at + chunk_rows, stop)) for at in range(start, stop, chunk_rows)]
        values = read(pieces[0], names)
        ranges = _extremes(values, read, pieces, group_bounds(rows, groups, first, last))
        for name in names:
            _set_ranges(name, arrays[name], first, last, *ranges[name])
        for piece in pieces:
            if len(pieces) > 1:
                values = read(piece, names)
            for name in names:
                _set_codes(arrays[name], piece, values[name])
        first = last
    return arrays


def _empty_array(rows: int, channels: int, bits: int, groups: int) -> QuantizedArray:
    low, step = np.empty((2, channels, groups), np.float32)
    return QuantizedArray(bits, rows, channels, low, step, np.empty((channels, plane_bytes(rows, bits)), np.uint8))


def _extremes(
    values: dict[str, np.ndarray], read: _Read, pieces: Sequence[slice], bounds: np.ndarray
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Smallest and largest values ([c, groups] f32) of the groups in one piece, or of one group in several pieces."""
    starts = bounds[:-1] - bounds[0]
    ranges = {
        name: (np.minimum.reduceat(plane, starts, axis=1), np.maximum.reduceat(plane, starts, axis=1))
        for name, plane in values.items()
    }
    for piece in pieces[1:]:
        for name, plane in read(piece, list(values)).items():
            low, high = ranges[name]
            np.minimum(low, plane.min(axis=1, keepdims=True), out=low)
            np.maximum(high, plane.max(axis=1, keepdims=True), out=high)
    return ranges


def _set_ranges(name: str, array: QuantizedArray, first: int, last: int, low: np.ndarray, high: np.ndarray) -> None:
    """Set low and step of groups [first, last)."""
    # NaN passes through minimum and maximum, and fails both comparisons.
    bad = ~((low >= -LARGEST) & (high <= LARGEST))
    if bad.any():
        channel, group = np.argwhere(bad)[0]
        start, stop = group_bounds(array.count, array.groups, first + int(group), first + int(group) + 1)
        raise InputError(
            f"{name}: channel {channel}, kept rows {start} to {stop - 1}: values from {low[channel, group]} to "
            f"{high[channel, group]}, expected finite numbers of magnitude up to {LARGEST:.3g}"
        )
    step = ((high.astype(np.float64) - low) / (2**array.bits - 1)).astype(np.float32)
    step[step < SMALLEST_STEP] = 0
    array.low[:, first:last] = low + np.float32(0)  # turns -0 into 0: either may come out as the minimum of both
    array.step[:, first:last] = step


def _set_codes(array: QuantizedArray, rows: slice, values: np.ndarray) -> None:
    """Pack the codes of `rows`, one channel at a time, so that temporary arrays stay in the processor's cache."""
    groups, sizes = _groups_of_rows(rows.start, rows.stop, array.count, array.groups)
    low, step = array.low[:, groups], array.step[:, groups]
    divisors = np.where(step == 0, np.float32(1), step)
    for channel in range(array.channels):
        code = values[channel] - np.repeat(low[channel], sizes)
        code /= np.repeat(divisors[channel], sizes)
        np.rint(code, out=code)
        np.clip(code, 0, 2**array.bits - 1, out=code)
        pack_into(array.planes[channel], array.bits, rows.start, code.astype(np.uint16))


def _groups_of_rows(start: int, stop: int, rows: int, groups: int) -> tuple[slice, np.ndarray]:
    """The groups that rows [start, stop) touch, and the number of these rows in each group."""
    first, last = group_of(start, rows, groups), group_of(stop - 1, rows, groups)
    bounds = group_bounds(rows, groups, first, last + 1)
    bounds[0], bounds[-1] = start, stop
    return slice(first, last + 1), np.diff(bounds)
