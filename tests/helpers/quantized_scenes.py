"""Scenes for the tests of pruning, quantization and the container."""

from __future__ import annotations

import numpy as np

from flexgs_edge.methods.paper.prune import nonzero_sh
from flexgs_edge.packed.bitpack import PAPER, BitSpec
from flexgs_edge.packed.quantize import SMALLEST_STEP, QuantizedArray, QuantizedScene, _quantize_stream, quantize_scene
from flexgs_edge.scene.fields import FIELDS
from flexgs_edge.scene.source import MemorySource


def make_scene(count: int, sh_degree: int = 1, seed: int = 0, sh_share: float = 0.5) -> MemorySource:
    """A random scene in which about `sh_share` of the rows have SH."""
    rng = np.random.default_rng(seed)
    arrays = {f.name: rng.normal(size=(f.width(sh_degree), count)).astype(np.float32) for f in FIELDS}
    arrays["sh_rest"][:, rng.random(count) >= sh_share] = 0
    return MemorySource(arrays, sh_degree, (1234.5, -0.1, 1e-7))


def quantize_all(
    source: MemorySource, bits: BitSpec = PAPER, groups: int | None = None, chunk_rows: int = 65536
) -> QuantizedScene:
    """Quantize every row; those without SH go to the second block."""
    has_sh = nonzero_sh(source)
    return quantize_scene(source, np.flatnonzero(has_sh), np.flatnonzero(~has_sh), bits, groups, chunk_rows)


def assert_same_codes(one: QuantizedScene, two: QuantizedScene) -> None:
    """Equal to the last bit."""
    assert (one.count, one.sh_count, one.sh_degree) == (two.count, two.sh_count, two.sh_degree)
    np.testing.assert_array_equal(one.origin, two.origin)
    for field in FIELDS:
        a, b = one.arrays[field.name], two.arrays[field.name]
        assert (a.bits, a.count, a.channels) == (b.bits, b.count, b.channels)
        for part in ("low", "step", "planes"):
            x, y = getattr(a, part), getattr(b, part)
            assert x.dtype == y.dtype and x.shape == y.shape, (field.name, part)
            assert x.tobytes() == y.tobytes(), (field.name, part)


def quantize_array(values: np.ndarray, bits: int, groups: int) -> QuantizedArray:
    """Quantize an array that lies in memory.

    `values`: [c, n] f32, finite, magnitudes up to `LARGEST`.

    Raises `InputError` if a value is not finite or too large.
    """
    values = np.asarray(values, np.float32)
    channels, rows = values.shape
    layouts = {"values": (channels, bits)}
    return _quantize_stream(lambda part, names: {"values": values}, layouts, rows, groups, rows)["values"]


def largest_error(array: QuantizedArray) -> np.ndarray:
    """Bound on the error |x' - x| of the quantizer, per channel and group.

    It is half a step, plus the float32 roundings of the step (times the largest code), of (x - lo) / step, of code *
    step and of the sum. Each rounding is at most 2^-24 of the largest number in it.

    Returns [c, G] f64.
    """
    low, step = array.low.astype(np.float64), array.step.astype(np.float64)
    span = step * (2**array.bits - 1)
    # A step that underflowed to zero stands for a range of at most (2^bits - 1) * SMALLEST_STEP.
    lost = np.where(step == 0, SMALLEST_STEP * (2**array.bits - 1), 0.0)
    bound: np.ndarray = step / 2 + 2.0**-22 * span + 2.0**-24 * np.maximum(abs(low), abs(low + span)) + lost
    return bound
