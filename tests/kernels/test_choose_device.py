"""Devices: which one is taken, what is said when none is, and how a session fails."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from flexgs_edge.errors import BudgetError, DeviceError
from flexgs_edge.kernels.backend import CODEC_KERNELS, KERNELS, TwinBackend
from flexgs_edge.kernels.choose_device import SELF_TEST, DeviceInfo, choose_device, list_devices, run_self_test
from flexgs_edge.kernels.opencl import SMALL_WRITE, OpenCLBackend
from flexgs_edge.kernels.tested import open_backend
from flexgs_edge.memory.budget import MemoryBudget
from kernel_fixtures import default_device, large_budget

POCL = "Portable Computing Language"
BROKEN = "kernel does not build or run: error: unknown target CPU 'generic'"


def device(
    index: int, name: str, platform: str = POCL, kind: str = "cpu", self_test: str = "ok", width: int = 16
) -> DeviceInfo:
    return DeviceInfo(
        index, name, platform, kind, "1.0", "OpenCL C 1.2", 2, width, 4096, 1 << 20, 1 << 32, 1 << 30, self_test
    )


INTEL = device(0, "AMD EPYC", "Intel(R) OpenCL")
PIP_POCL = device(1, "pthread-AMD EPYC", self_test=BROKEN)
DEB_POCL = device(2, "pthread-skylake-avx512-AMD EPYC")
MALI = device(3, "Mali-G610", "ARM Platform", "gpu", width=1)
BROKEN_GPU = device(4, "GeForce", "NVIDIA CUDA", "gpu", "fma() is not exact", 1)
ALL = [INTEL, PIP_POCL, DEB_POCL, MALI, BROKEN_GPU]


@pytest.mark.parametrize(
    ("spec", "devices", "expected", "why"),
    [
        (None, ALL, MALI, "first GPU that works"),
        (None, [INTEL, PIP_POCL, DEB_POCL, BROKEN_GPU], DEB_POCL, "no GPU works"),
        (None, [INTEL, PIP_POCL], INTEL, "first CPU device"),
        ("0", ALL, INTEL, "--device 0"),
        ("3", ALL[::-1], MALI, "--device 3"),
        ("cpu", ALL, INTEL, "--device cpu"),
        ("gpu", ALL, MALI, "--device gpu"),
        ("mali", ALL, MALI, "--device mali"),
        ("Portable", ALL, DEB_POCL, "--device Portable"),
        ("intel(r)", ALL, INTEL, "--device intel(r)"),
        ("EPYC", ALL[1:], DEB_POCL, "--device EPYC"),
    ],
)
def test_choice(spec: str | None, devices: list[DeviceInfo], expected: DeviceInfo, why: str) -> None:
    chosen, reason = choose_device(spec, devices)
    assert chosen is expected
    assert why in reason


@pytest.mark.parametrize(
    ("spec", "devices", "words"),
    [
        (None, [], ["no OpenCL device found", "apt install pocl-opencl-icd", "--device numpy"]),
        ("gpu", [], ["no OpenCL device found"]),
        (
            None,
            [PIP_POCL, BROKEN_GPU],
            ["no OpenCL device passed the self-test", "unknown target CPU", "fma() is not exact"],
        ),
        ("1", ALL, ["--device 1", "failed the self-test", "unknown target CPU", "--device numpy"]),
        ("9", ALL, ["--device 9", "no such OpenCL device", "Mali-G610", "[2]"]),
        ("gpu", [DEB_POCL], ["--device gpu", "no such OpenCL device", "pthread-skylake"]),
        ("radeon", ALL, ["--device radeon", "no such OpenCL device", "ARM Platform"]),
        ("geforce", ALL, ["--device geforce", "failed the self-test", "fma() is not exact"]),
    ],
)
def test_no_choice(spec: str | None, devices: list[DeviceInfo], words: list[str]) -> None:
    """An error that lists what is there; never another device than the one asked for."""
    with pytest.raises(DeviceError) as caught:
        choose_device(spec, devices)
    for word in words:
        assert word in str(caught.value)


def test_devices_of_this_machine() -> None:
    found = list_devices()
    assert [info.index for info in found] == list(range(len(found)))
    info = default_device()
    assert info.self_test == "ok" and info.usable and info.compute_units > 0
    described = info.to_json()
    assert "handle" not in described and described["name"] == info.name
    assert {entry.self_test for entry in list_devices(self_test=False)} == {"not run"}


@pytest.mark.parametrize(
    ("source", "verdict"),
    [
        ("fma(x, y, -y)", "ok"),
        ("fma(x, y, -y) + 0.001f", r"fma\(\) is not exact"),
        ("syntax error", "kernel does not build or run: .*error.*"),
    ],
)
def test_self_test_can_fail(source: str, verdict: str) -> None:
    assert SELF_TEST.count("fma(x, y, -y)") == 1
    found, _ = run_self_test(default_device().context, SELF_TEST.replace("fma(x, y, -y)", source))
    assert re.fullmatch(verdict, found)


def test_self_test_sees_contraction() -> None:
    contracted = SELF_TEST.replace("x * y - y", "fma(x, y, -y)")
    assert "fused" in run_self_test(default_device().context, contracted)[0]


def test_no_platform(tmp_path: Path) -> None:
    """No OpenCL runtime installed: the loader's PLATFORM_NOT_FOUND becomes a message that says what to do."""
    code = (
        "from flexgs_edge.memory.budget import MemoryBudget\n"
        "from flexgs_edge.errors import DeviceError\n"
        "from flexgs_edge.kernels.tested import open_backend\n"
        "assert open_backend('numpy', MemoryBudget(1 << 30)).is_numpy\n"
        "try:\n    open_backend(None, MemoryBudget(1 << 30))\n"
        "except DeviceError as error:\n    print(error)\n"
    )
    environment = {
        **os.environ,
        "OCL_ICD_VENDORS": str(tmp_path),
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
    }
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert "no OpenCL device found" in done.stdout and "apt install pocl-opencl-icd" in done.stdout


def test_open_backend() -> None:
    assert isinstance(open_backend("numpy", large_budget()), TwinBackend)
    backend = open_backend(str(default_device().index), large_budget())
    assert isinstance(backend, OpenCLBackend)
    assert backend.describe()["name"] == default_device().name
    assert backend.describe()["width"] in (1, 4, 8, 16)
    assert backend.startup_seconds > 0 and backend.compile_seconds == 0
    with pytest.raises(DeviceError, match="no such OpenCL device"):
        open_backend("no such thing", large_budget())


@pytest.mark.parametrize(("width", "form"), [(2, "cpu"), (32, "cpu"), (8, "gpu")])
def test_widths_that_there_are_not(width: int, form: str) -> None:
    with pytest.raises(DeviceError, match=f"vector width {width} of the {form} form: expected"):
        OpenCLBackend(default_device(), large_budget(), width=width, form=form)


@pytest.fixture
def session() -> OpenCLBackend:
    return OpenCLBackend(default_device(), MemoryBudget(1 << 20))


def test_build_failure(session: OpenCLBackend) -> None:
    """The message has the kernel, the device, the options and the compiler's words."""
    with pytest.raises(DeviceError) as caught:
        session.kernel(
            "__kernel void broken(__global float *x) { x[0] = nonsense; }", "broken", ("-DW=16", "-DSTATS=1"), "b"
        )
    for word in ("broken", default_device().name, "-DW=16", "-DSTATS=1", "nonsense"):
        assert word in str(caught.value)


def test_missing_define() -> None:
    """Kernels refuse to build without their defines instead of guessing."""
    from flexgs_edge.kernels.cl_sources import load_source

    session = OpenCLBackend(default_device(), large_budget())
    for name, options in (
        ("activate.cl", ()),
        ("blend_cpu.cl", ("-DW=16",)),
        ("blend_gpu.cl", ("-DW=8", "-DSTATS=0", "-DBLEND=blend")),
    ):
        with pytest.raises(DeviceError, match="does not build"):
            session.kernel(load_source(name), "blend" if "blend" in name else "activate", options, "b")


def test_programs_are_built_once(session: OpenCLBackend) -> None:
    source = "__kernel void one(__global float *x) { x[0] = 1; } __kernel void two(__global float *x) { x[0] = 2; }"
    session.kernel(source, "one", (), "b")
    seconds = session.compile_seconds
    session.kernel(source, "two", (), "b")
    assert session.compile_seconds == seconds > 0
    other = OpenCLBackend(default_device(), MemoryBudget(1 << 20))
    other.kernel(source, "two", (), "b")
    assert other.compile_seconds == 0


def test_arrays_are_counted(session: OpenCLBackend) -> None:
    array = session.array((1000,), np.float32)
    assert session.budget.used == 4000
    session.write(array, np.arange(10, dtype=np.float32), 7)
    np.testing.assert_array_equal(session.read(array, np.empty(3, np.float32), 8), [1, 2, 3])
    session.fill(array, 5)
    assert (session.read(array) == 5).all()
    array.release()
    array.release()
    assert session.budget.used == 0
    empty = session.array((0, 5), np.float32)
    assert session.read(empty).shape == (0, 5)
    session.fill(empty, 1)
    empty.release()
    with pytest.raises(BudgetError, match="use --memory-limit"):
        session.array((1 << 20,), np.float32)
    assert session.budget.used == 0


SLOW = """__kernel void slow(__global const float *given, __global float *seen) {
  volatile float busy = 0;
  for (uint k = 0; k < 20000000; ++k) busy += 1.0f;
  seen[0] = given[0];
}"""
TRIES = 5
"""On a busy machine the host may lie idle while a kernel runs, as if it waited."""


def test_small_writes_do_not_wait(session: OpenCLBackend) -> None:
    """Kernels before a write see the old values, those after it the new ones, whatever becomes of the host's array."""
    given, seen = session.array((4,), np.float32), session.array((4,), np.float32)
    kernel = session.kernel(SLOW, "slow", (), "bb")
    for _ in range(TRIES):
        values = np.full(4, 1, np.float32)
        session.write(given, values)
        start = time.perf_counter()
        session.enqueue("slow", kernel, (1,), (1,), (given, seen))
        values[:] = 2
        session.write(given, values)
        values[:] = 3
        behind = time.perf_counter() - start
        assert session.read(seen, np.empty(1, np.float32)) == [1]
        early = behind < (time.perf_counter() - start) / 2
        assert (session.read(given) == 2).all()
        if early:
            break
    assert early
    # Another write to the same array comes after it, and so do values that are mapped.
    session.enqueue("slow", kernel, (1,), (1,), (given, seen))
    session.write(given, values)
    session.write(given, values + 1)
    assert session.read(seen, np.empty(1, np.float32)) == [2]
    assert (session.read(given) == 4).all()
    for change in (session.write, session.fill):
        session.enqueue("slow", kernel, (1,), (1,), (seen, seen))
        change(given, 0 if change == session.fill else values)
        with session.mapped(given) as mapped:
            mapped[:] = 5
        assert (session.read(given) == 5).all()
    given.release()
    seen.release()


@pytest.mark.parametrize("waits", [False, True])
def test_values_that_stay_are_not_waited_for(
    session: OpenCLBackend, waits: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Writes of values that stay, and reads that need not wait, come in the queue's order; very large writes wait."""
    if waits:
        monkeypatch.setattr("flexgs_edge.kernels.opencl.HELD_WRITE", SMALL_WRITE)
    given, seen = session.array((SMALL_WRITE // 4 + 1,), np.float32), session.array((1,), np.float32)
    kernel = session.kernel(SLOW, "slow", (), "bb")
    session.write(given, np.full(given.shape, 1, np.float32))
    for _ in range(TRIES):
        session.write(given, np.full(given.shape, 1, np.float32))
        start = time.perf_counter()
        session.enqueue("slow", kernel, (1,), (1,), (given, seen))
        session.write(given, np.full(given.shape, 2, np.float32), stays=True)
        found = session.read(seen, waits=False)
        behind = time.perf_counter() - start
        assert (session.read(given) == 2).all() and found == [1]
        waited = behind > (time.perf_counter() - start) / 2
        if waited == waits:
            break
    assert waited == waits
    given.release()
    seen.release()


def test_buffers_beyond_the_device() -> None:
    """What the budget allows and the device refuses is a budget error that names the device's limit."""
    session = OpenCLBackend(default_device(), MemoryBudget(1 << 62))
    with pytest.raises(BudgetError, match=str(default_device().max_alloc_bytes)):
        session.array((1 << 44,), np.uint8)
    assert session.budget.used == 0


def test_every_signature_fits_its_kernel() -> None:
    """One letter an argument: the numbers that the kernels were compiled with."""
    from flexgs_edge.kernels.cl_sources import load_source

    session = OpenCLBackend(default_device(), large_budget())
    for form, width in (("cpu", 8), ("gpu", 1)):
        for name, spec in {**KERNELS, **CODEC_KERNELS}.items():
            source = load_source(spec.file.format(form=form), spec.stats, form)
            kernel = session.kernel(source, name, (f"-DW={width}",), spec.signature)
            assert kernel.num_args == len(spec.signature), name
