"""The shared functions and constants of the kernels, alone: read back from the device through throw-away kernels."""

from __future__ import annotations

import re

import numpy as np
import pytest

import flexgs_edge.constants as constants
from flexgs_edge.kernels.cl_sources import constants_header, kernel_dir
from flexgs_edge.kernels.opencl import OpenCLBackend
from flexgs_edge.kernels.twins.arithmetic import f32, fexp2, flog2, fma
from kernel_fixtures import FORMS, open_form, same_bits

EXP2_ERROR = 2.15e-7
"""Largest relative error over all float32 in [-0.5, 0.5]: 2.142e-7 at -0.4421016."""


def run_probe(
    form: str, body: str, inputs: list[np.ndarray], outputs: int = 1, dtype: type = np.float32
) -> list[np.ndarray]:
    """Run a throw-away kernel after constants and common.clh; `body` reads x0, x1, ... and writes y0, y1, ... at i."""
    backend = open_form(form)
    assert isinstance(backend, OpenCLBackend)
    names = [f"__global const float *x{k}" for k in range(len(inputs))]
    kind = "uint" if dtype is np.uint32 else "float"
    names += [f"__global {kind} *y{k}" for k in range(outputs)]
    source = constants_header() + (kernel_dir() / "common.clh").read_text()
    source += f"\n__kernel void probe({', '.join(names)}) {{ const size_t i = get_global_id(0) * W; {body} }}\n"
    session = backend
    options = (f"-DW={backend.width}", *(["-DWRITTEN_FMA"] if backend.written_fma else []))
    kernel = session.kernel(source, "probe", options, "b" * len(names))
    size = inputs[0].size if inputs else backend.width
    arrays = [session.array((size,), np.float32) for _ in inputs] + [
        session.array((size,), dtype) for _ in range(outputs)
    ]
    for array, values in zip(arrays, inputs):
        session.write(array, values)
    session.enqueue("probe", kernel, (size // backend.width,), (1,), tuple(arrays))
    results = [session.read(array) for array in arrays[len(inputs) :]]
    for array in arrays:
        array.release()
    return results


def any_floats(count: int, seed: int) -> np.ndarray:
    """float32 of random bits: NaN, infinities and denormals among them."""
    bits = np.random.default_rng(seed).integers(0, 2**32, count, dtype=np.uint32)
    special = np.array([0, -0.0, np.inf, -np.inf, np.nan, 1e-45, -1e-45, 3.4e38, -3.4e38, 1, -1, 0.5, -0.5], np.float32)
    bits[: special.size] = special.view(np.uint32)
    return bits.view(np.float32)


def test_limits_of_the_exponent_are_those_of_alpha() -> None:
    """Kernels compare and cap exponents: to the bit what alpha, as computed, would be compared and capped to."""
    low, high = (
        np.sort((f32(limit).view(np.int32) + np.arange(-(1 << 16), 1 << 16, dtype=np.int32)).view(f32))
        for limit in (constants.LOG2_ALPHA_MIN, constants.LOG2_ALPHA_MAX)
    )
    seen = low >= f32(constants.LOG2_ALPHA_MIN)
    np.testing.assert_array_equal(seen, fexp2(low) >= f32(constants.ALPHA_MIN))
    assert 0 < seen.sum() < len(seen)
    capped = fexp2(np.minimum(high, f32(constants.LOG2_ALPHA_MAX)))
    assert capped.max() == capped[-1] == f32(constants.ALPHA_MAX) < fexp2(high).max()


@pytest.mark.parametrize("form", [*FORMS, "fma"])
def test_fma_of_all_numbers(form: str) -> None:
    """Any bits, sums that nearly cancel, sums at half an ulp. Written out, subnormal results and infinite products may differ."""
    count = 1 << 18
    random = np.random.default_rng(5)
    a, b = ((any_floats(count, seed)) for seed in (6, 7))
    c = any_floats(count, 8)
    scale = np.float32(2.0) ** random.integers(-40, 40, (2, count)).astype(np.float32)
    near_a, near_b = (random.normal(size=(2, count)).astype(np.float32) * scale).astype(np.float32)
    exact = near_a.astype(np.float64) * near_b
    near_c = (-exact * (1 + random.choice([0, 1e-7, -1e-7, 1e-8, 1e-3, -2, 3e7, -3e-8], count))).astype(np.float32)
    # Products of 12 bits are exact, and so are halves of the last place of c: ties that go to even.
    short_a, short_b = (1 + random.integers(0, 1 << 11, (2, count)) * 2.0**-11).astype(np.float32)
    tie_c = (random.integers(1 << 23, 1 << 24, count) * 2.0 ** random.integers(-3, 4, count)).astype(np.float32)
    with np.errstate(all="ignore"):
        x = (
            np.concatenate([a, near_a, short_a]),
            np.concatenate([b, near_b, short_b]),
            np.concatenate([c, near_c, tie_c]),
        )
        expected = fma(*x)
    (got,) = run_probe(form, "STOREF(fma(LOADF(x0, i), LOADF(x1, i), LOADF(x2, i)), y0, i);", list(x))
    if form == "fma":
        with np.errstate(all="ignore"):
            subnormal = (expected != 0) & (np.abs(expected) < np.finfo(np.float32).tiny)
            steady = ~subnormal & ~(np.isinf(x[0] * x[1]) & np.isfinite(expected))
        assert steady.mean() > 0.99
        expected, got = expected[steady], got[steady]
    assert same_bits(got, expected)


@pytest.mark.parametrize("form", FORMS)
def test_exp2_over_its_whole_range(form: str) -> None:
    """Relative error between the clamps, the ends beyond them, NaN passed on; the same bits as the twin."""
    x = np.concatenate(
        [
            np.linspace(-126.5, 127.5, 1 << 17, dtype=np.float32),
            np.linspace(-8.1, 0.1, 1 << 17, dtype=np.float32),
            np.linspace(-0.45, -0.43, 1 << 17, dtype=np.float32),
            any_floats(1 << 17, 1),
        ]
    )
    (y,) = run_probe(form, "STOREF(fexp2(LOADF(x0, i)), y0, i);", [x])
    with np.errstate(invalid="ignore"):  # signalling NaN
        assert same_bits(y, fexp2(x))
    known = ~np.isnan(x)
    plain = (x.view(np.uint32) & 0x1FF) == 0  # NaN that arithmetic makes; other payloads are the business of `activate`
    assert np.isnan(y[~known & plain]).all() and (~known & plain).any()
    exact = np.exp2(np.clip(x[known].astype(np.float64), -126, 127))
    assert (abs(y[known] - exact) <= EXP2_ERROR * exact).all()
    assert (y[known] > 0).all() and np.isfinite(y[known]).all()


@pytest.mark.parametrize("form", FORMS)
def test_division_is_rounded_once(form: str) -> None:
    """Of weights and transmittances, as the removal costs and the gradients divide them."""
    rng = np.random.default_rng(3)
    x = rng.random(1 << 18, dtype=np.float32)
    z = np.exp2(-14 * rng.random(len(x))).astype(np.float32) * np.where(
        rng.random(len(x)) < 0.5, np.float32(-1), np.float32(1)
    )
    (y,) = run_probe(form, "STOREF(LOADF(x0, i) / LOADF(x1, i), y0, i);", [x, z])
    assert same_bits(y, x / z)


@pytest.mark.parametrize("form", FORMS)
def test_log2_over_all_normal_numbers(form: str) -> None:
    """Absolute error 7.1e-8 and half an ulp of the result; every 7th mantissa of three octaves, and random bits."""
    step = np.arange(0, 1 << 23, 7, dtype=np.uint32)
    octaves = [(step | np.uint32(exponent << 23)).view(np.float32) for exponent in (119, 126, 127)]
    bits = np.random.default_rng(2).integers(1 << 23, 255 << 23, 1 << 16, dtype=np.uint32)
    x = np.concatenate([*octaves, bits.view(np.float32), np.ones(16, np.float32)])
    x = x[: x.size // 16 * 16]
    (y,) = run_probe(form, "STOREF(flog2(LOADF(x0, i)), y0, i);", [x])
    assert same_bits(y, flog2(x))
    exact = np.log2(x.astype(np.float64))
    assert (abs(y - exact) <= 7.1e-8 + abs(np.spacing(exact.astype(np.float32))) / 2).all()
    assert (y[x == 1] == 0).all()


@pytest.mark.parametrize("form", FORMS)
def test_fma_rounds_once(form: str) -> None:
    """fma against exact rational arithmetic by halves, and a * b + c as two roundings."""
    rng = np.random.default_rng(3)
    a, b = rng.normal(size=(2, 1 << 14)).astype(np.float32)
    c = (-a.astype(np.float64) * b * (1 + rng.choice([0, 1e-7, -3e-8, 1e-3, 10], a.size))).astype(np.float32)
    body = "FW p = LOADF(x0, i), q = LOADF(x1, i), r = LOADF(x2, i); STOREF(fma(p, q, r), y0, i); STOREF(p * q + r, y1, i);"
    fused, separate = run_probe(form, body, [a, b, c], 2)
    assert same_bits(fused, fma(a, b, c))
    assert same_bits(separate, a * b + c)
    assert (fused != separate).mean() > 0.1  # otherwise this says nothing


def test_twin_fma_at_ties() -> None:
    """A float64 sum midway between two float32 that was itself rounded: the twin must look at what was lost."""
    one, tiny = np.ones(1, np.float32), np.float32(2.0**-60)
    a = np.array([1 + 2.0**-12, 1 + 2.0**-12, 1 + 2.0**-12], np.float32)  # squared: 1 + 2^-11 + 2^-24, a tie
    c = np.array([0, tiny, -tiny], np.float32)
    expected = np.array([1 + 2.0**-11, 1 + 2.0**-11 + 2.0**-23, 1 + 2.0**-11], np.float32)
    assert same_bits(fma(a, a, c), expected)
    assert same_bits(fma(one, one, one), one + one)


def _defined() -> dict[str, str]:
    return dict(re.findall(r"^#define (\w+) (\S+)$", constants_header(), re.MULTILINE))


def test_every_number_is_printed() -> None:
    """Every number of constants.py, tuples one by one."""
    expected = set()
    for name, value in vars(constants).items():
        if isinstance(value, tuple):
            expected |= {f"{name}_{k}" for k in range(len(value))}
        elif name.isupper() and isinstance(value, (int, float)):
            expected.add(name)
    used = set(re.findall(r"\b[A-Z][A-Z0-9_]{2,}\b", "".join(p.read_text() for p in kernel_dir().glob("*.cl*"))))
    assert set(_defined()) <= expected
    assert expected & used <= set(_defined())
    assert {"ALPHA_MIN", "DILATION", "SH_C3_6", "EXP2_POLY_0", "CULLED", "TILE"} <= set(_defined())


def test_constants_on_the_device() -> None:
    """Read back: floats are the nearest float32, integers are exact."""
    names = sorted(_defined())
    floats: dict[str, float] = {}
    integers: dict[str, int] = {}
    for name in names:
        head, _, last = name.rpartition("_")
        value = getattr(constants, name) if hasattr(constants, name) else getattr(constants, head)[int(last)]
        (floats if isinstance(value, float) else integers)[name] = value
    body = "".join(f"y0[{k}] = {name};" for k, name in enumerate(floats))
    got = _read_scalars(body, len(floats), np.float32)
    np.testing.assert_array_equal(got, np.array(list(floats.values()), np.float32))
    body = "".join(f"y0[{k}] = (uint)({name});" for k, name in enumerate(integers))
    got = _read_scalars(body, len(integers), np.uint32)
    np.testing.assert_array_equal(got, np.array(list(integers.values()), np.uint32))


def _read_scalars(body: str, count: int, dtype: type) -> np.ndarray:
    backend = open_form("w1")
    assert isinstance(backend, OpenCLBackend)
    kind = "uint" if dtype is np.uint32 else "float"
    source = constants_header() + (kernel_dir() / "common.clh").read_text()
    source += f"\n__kernel void probe(__global {kind} *y0) {{ {body} }}\n"
    kernel = backend.kernel(source, "probe", ("-DW=1",), "b")
    array = backend.array((count,), dtype)
    backend.enqueue("probe", kernel, (1,), (1,), (array,))
    values = backend.read(array)
    array.release()
    return values
