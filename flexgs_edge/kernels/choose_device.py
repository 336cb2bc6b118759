"""List the OpenCL devices, test whether they work, and choose one."""

from __future__ import annotations

import ctypes
import os
import warnings
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from flexgs_edge.errors import DeviceError
from flexgs_edge.kernels.compiler_cache import prepare_compiler_cache

if TYPE_CHECKING:
    import pyopencl as cl


HINT = (
    "install an OpenCL runtime (Debian, Ubuntu, Jetson: `apt install pocl-opencl-icd`) or run the NumPy twins with "
    "`--device numpy` (same results, far slower)"
)

RETEST = "A new version of its driver is tested anew by itself; `flexgs-edge devices --self-test` tests all devices now"

# Fused and separate multiply-add on vectors of 16. It catches runtimes that cannot build for this processor, such as
# PoCL's wheels on newer CPUs. It also catches those that fuse operations they must not fuse, or that miss lanes.
SELF_TEST = """
#pragma OPENCL FP_CONTRACT OFF
__kernel void self_test(__global const float *a, __global const float *b, __global float *out) {
  const size_t i = get_global_id(0) * 16;
  float16 x = vload16(0, a + i), y = vload16(0, b + i);
  vstore16(fma(x, y, -y), 0, out + i);
  vstore16(x * y - y, 0, out + 64 + i);
  vstore16(1.0f / sqrt(x), 0, out + 128 + i);
}
// Mesa's llvmpipe leaves loops after 65535 steps, without a word.
__kernel void count_steps(const uint steps, __global const uint *ones, __global uint *out) {
  uint sum = 0;
  for (uint i = 0; i < steps; ++i) sum += ones[i & 3];
  out[0] = sum;
}
"""
PROBED_STEPS = 1 << 20
"""Steps of the loop that looks for a limit. A limit beyond it would not be noticed; none is known."""
LEAST_STEPS = 65535
"""With fewer steps of all loops together, no work-item of ours could do its part: such devices are refused."""


_loaded_by: int | None = None  # the process that has loaded OpenCL runtimes


@dataclass(frozen=True)
class DeviceInfo:
    """One OpenCL device: its limits, and whether it passed the self-test.

    `self_test` is "ok", "not run", or the reason why the device cannot be used.
    """

    index: int
    name: str
    platform: str
    type: str
    driver: str
    opencl_c: str
    compute_units: int
    native_width: int
    max_work_group: int
    local_bytes: int
    global_bytes: int
    max_alloc_bytes: int
    self_test: str
    loop_steps: int = 0
    """Steps after which the runtime leaves loops, counted over all loops of a work-item; 0 if it does not."""
    form: str = ""  # Name of the form of the kernels that was measured to be fastest; empty if none was
    handle: cl.Device | None = field(default=None, repr=False, compare=False)
    context: cl.Context | None = field(default=None, repr=False, compare=False)
    """The context of the self-test, kept alive: after the last context is gone, PoCL starts its compiler anew for the
    next."""

    @property
    def usable(self) -> bool:
        """Whether the device passed the self-test, or the test was not run."""
        return self.self_test in ("ok", "not run")

    def to_json(self) -> dict[str, Any]:
        """All fields but the handle and the context, as JSON values."""
        fields = asdict(DeviceInfo(**{**self.__dict__, "handle": None, "context": None}))
        del fields["handle"], fields["context"]
        return fields


def list_devices(self_test: bool = True) -> list[DeviceInfo]:
    """Every device of every OpenCL platform, in the order of the OpenCL loader.

    `self_test`: build and run a small kernel on each device, and compare its result with NumPy's. Before a device is
    used, it must pass more than this: `flexgs_edge.kernels.tested`.
    """
    import pyopencl as cl

    global _loaded_by
    if _loaded_by not in (None, os.getpid()):
        raise DeviceError(
            "this process was forked from one that uses OpenCL, whose threads it lacks: start it by another way "
            "(multiprocessing.set_start_method('spawn')), or use device='numpy'"
        )
    _loaded_by = os.getpid()
    prepare_compiler_cache()
    try:
        platforms = cl.get_platforms()
    except cl.LogicError:  # PLATFORM_NOT_FOUND_KHR: no runtime is installed
        return []
    found: list[DeviceInfo] = []
    for platform in platforms:
        try:
            devices = platform.get_devices()
        except cl.Error:  # a platform without devices may raise DEVICE_NOT_FOUND
            continue
        for device in devices:
            found.append(_describe(len(found), platform, device, self_test))
    return found


def _describe(index: int, platform: Any, device: Any, self_test: bool) -> DeviceInfo:
    import pyopencl as cl

    kind = "gpu" if device.type & cl.device_type.GPU else "cpu" if device.type & cl.device_type.CPU else "other"
    info = DeviceInfo(
        index=index,
        name=device.name.strip(),
        platform=platform.name.strip(),
        type=kind,
        driver=device.driver_version.strip(),
        opencl_c=device.opencl_c_version.strip(),
        compute_units=device.max_compute_units,
        native_width=device.native_vector_width_float,
        max_work_group=device.max_work_group_size,
        local_bytes=device.local_mem_size,
        global_bytes=device.global_mem_size,
        max_alloc_bytes=device.max_mem_alloc_size,
        self_test="not run",
        handle=device,
    )
    return probed(info) if self_test else info


def probed(info: DeviceInfo) -> DeviceInfo:
    """`info` with the verdict of `run_self_test`, and its context."""
    import pyopencl as cl

    assert info.handle is not None
    try:
        context = cl.Context([info.handle])
    except cl.Error as error:
        return replace(info, self_test=f"no context: {_first_line(str(error))}")
    verdict, steps = run_self_test(context)
    return replace(info, self_test=verdict, loop_steps=steps, context=context)


def run_self_test(context: cl.Context, source: str = SELF_TEST) -> tuple[str, int]:
    """Run the self-test of this source; returns `ok`, or one line about the failure, and `DeviceInfo.loop_steps`."""
    import pyopencl as cl

    a = np.linspace(0.5, 3.0, 64, dtype=np.float32)
    b = np.linspace(-7.0, 5.0, 64, dtype=np.float32)
    got = np.empty(192, np.float32)
    flags = cl.mem_flags
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            program = cl.Program(context, source).build(options=["-cl-std=CL1.2"], cache_dir=False)  # type: ignore[arg-type]
        queue = cl.CommandQueue(context)
        inputs = [cl.Buffer(context, flags.READ_ONLY | flags.COPY_HOST_PTR, hostbuf=x) for x in (a, b)]
        output = cl.Buffer(context, flags.WRITE_ONLY, got.nbytes)
        cl.Kernel(program, "self_test")(queue, (4,), (1,), *inputs, output)
        cl.enqueue_copy(queue, got, output)
        steps = np.ones(4, np.uint32)
        ones = cl.Buffer(context, flags.READ_ONLY | flags.COPY_HOST_PTR, hostbuf=steps)
        cl.Kernel(program, "count_steps")(queue, (1,), (1,), np.uint32(PROBED_STEPS), ones, output)
        cl.enqueue_copy(queue, steps, output)
        queue.finish()
    except cl.Error as error:
        return f"kernel does not build or run: {_first_line(str(error))}", 0
    exact = a.astype(np.float64) * b
    fused, separate = (exact - b).astype(np.float32), exact.astype(np.float32) - b
    if not np.array_equal(got[:64], fused):
        return "fma() is not exact", 0
    if not np.array_equal(got[64:128], separate):
        return "multiply and add are fused although FP_CONTRACT is off", 0
    if np.abs(got[128:] * np.sqrt(a) - 1).max() > 1e-6:
        return "1/sqrt() is wrong", 0
    if steps[0] < LEAST_STEPS:
        return f"loops end after {steps[0]} steps, {LEAST_STEPS} are needed", 0
    return "ok", 0 if steps[0] == PROBED_STEPS else int(steps[0])


def _first_line(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    errors = [line for line in lines if "error" in line.lower()]
    return (errors or lines or ["unknown error"])[0][:200]


def choose_device(spec: str | None, devices: list[DeviceInfo]) -> tuple[DeviceInfo, str]:
    """Choose the device that `spec` names; returns it with the reason.

    `spec`: an index, `cpu`, `gpu`, or a part of the name of a device or platform. None, the default, takes the first
    GPU that passed the self-test, else PoCL's CPU device, else any other CPU device. Raises `DeviceError` if no device
    matches, or the one that matches failed its self-test; the message lists all devices. We never take another device
    than the one asked for.
    """
    listing = "; ".join(f"[{d.index}] {d.name} ({d.platform}, {d.type}): {d.self_test}" for d in devices)
    if not devices:
        raise DeviceError(f"no OpenCL device found{_broken_runtimes()}: {HINT}")
    if spec is None:
        usable = [d for d in devices if d.usable]
        if not usable:
            raise DeviceError(f"no OpenCL device passed the self-test: {listing}. {RETEST}. To go on, {HINT}")
        ranked = sorted(
            usable, key=lambda d: (d.type != "gpu", "portable computing" not in d.platform.lower(), d.index)
        )
        return ranked[0], "first GPU that works" if ranked[
            0
        ].type == "gpu" else "no GPU works; first CPU device, PoCL before others"
    if spec.isdigit():
        matches = [d for d in devices if d.index == int(spec)]
    elif spec in ("cpu", "gpu"):
        matches = [d for d in devices if d.type == spec]
    else:
        matches = [d for d in devices if spec.lower() in f"{d.name} {d.platform}".lower()]
    if not matches:
        raise DeviceError(f"--device {spec}: no such OpenCL device{_broken_runtimes()}; there are: {listing}")
    for device in matches:
        if device.usable:
            others = [f"{d.index}" for d in matches if d is not device and d.usable]
            more = (
                f"; the first of {len(others) + 1} that match, --device {', '.join(others)} for others"
                if others
                else ""
            )
            return device, f"asked for by --device {spec}{more}"
    raise DeviceError(f"--device {spec}: failed the self-test: {listing}. {RETEST}. To go on, {HINT}")


def _broken_runtimes() -> str:
    """Words about runtimes that are installed, but whose library cannot be loaded. The loader passes over them in silence."""
    named = os.environ.get("OCL_ICD_VENDORS") or "/etc/OpenCL/vendors"
    found = []
    for file in sorted(Path(named).glob("*.icd")) if os.path.isdir(named) else [Path(named)]:
        try:
            library = file.read_text(encoding="utf-8").strip()
        except (OSError, ValueError):
            continue
        try:
            ctypes.CDLL(library)
        except OSError as error:
            found.append(f"{file} names {library}, which cannot be loaded ({error})")
    return f" ({'; '.join(found)})" if found else ""
