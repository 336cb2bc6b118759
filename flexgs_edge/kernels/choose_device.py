"""List the OpenCL devices, test whether they work, and choose one.

Forms of the kernels give the same bits by other work-items. Which one is fastest is measured: docs/devices.md#forms.
PoCL offers no device where it cannot write the folder of its compiled kernels, and ends the process where a file in it was cut:
`prepare_compiler_cache` sees to both.
"""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import struct
import tempfile
import warnings
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from flexgs_edge.errors import DeviceError
from flexgs_edge.progress import LOG

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
WIDTHS = (16, 8, 4, 1)  # Lanes that a vector may have
GPU_WIDTHS = (1, 4)
"""Pixels of a work-item of the GPU form. With 8, llvmpipe was no faster, and took four times as long to build."""
VARIABLE = "POCL_CACHE_DIR"  # PoCL's own environment variable for the folder
SHARED_MEMORY = "/dev/shm"
STAMP = "flexgs-edge-checked"  # A file whose time is that of the last check
FLUSHED = 120.0  # Seconds after which a file is on the disk, even if the power fails
ELF, BITCODE = b"\x7fELF\x02\x01", b"BC\xc0\xde"


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
    """The context of the self-test, kept alive: after the last context is gone, PoCL starts its compiler anew for the next."""

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

    `spec`: an index, `cpu`, `gpu`, or a part of the name of a device or platform. None, the default, takes the first GPU that
    passed the self-test, else PoCL's CPU device, else any other CPU device. Raises `DeviceError` if no device matches, or the
    one that matches failed its self-test; the message lists all devices. We never take another device than the one asked for.
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
            more = f"; the first of {len(others) + 1} that match, --device {', '.join(others)} for others"
            return device, f"asked for by --device {spec}{more if others else ''}"
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


@dataclass(frozen=True)
class Form:
    """One form of the kernels."""

    kind: str  # a tile is blended by one work-item, or by one work-group
    width: int  # lanes of a vector
    written_fma: bool = False  # whether `fma` is written out in `common.clh`, for devices whose own one is slow

    def __str__(self) -> str:
        return f"{self.kind}{self.width}{'+fma' if self.written_fma else ''}"

    @classmethod
    def named(cls, name: str) -> Form | None:
        """The form that has this name; None if none has.

        >>> Form.named("gpu4+fma"), Form.named("tpu")
        (Form(kind='gpu', width=4, written_fma=True), None)
        """
        match = re.fullmatch(r"(cpu|gpu)(16|8|4|1)(\+fma)?", name)
        return cls(match[1], int(match[2]), match[3] is not None) if match else None


def native_width(info: DeviceInfo) -> int:
    """Lanes of the device's own vectors."""
    return max(width for width in WIDTHS if width <= max(info.native_width, 1))


def likely_form(info: DeviceInfo) -> Form:
    """The form for a device of which nothing was measured: it follows the type."""
    # A pixel takes fewer steps than a tile, so the GPU form serves devices that end loops.
    return Form("gpu", 1) if info.type == "gpu" or info.loop_steps else Form("cpu", native_width(info))


def possible_forms(info: DeviceInfo) -> list[Form]:
    """Forms that the device can take, the likely one first, without those that write out `fma`."""
    forms = [Form("gpu", width) for width in GPU_WIDTHS if 256 // width <= info.max_work_group]
    if not info.loop_steps:
        forms.append(Form("cpu", native_width(info)))
    return sorted(forms, key=lambda form: form != likely_form(info))


@cache
def prepare_compiler_cache() -> None:
    """Name another folder if PoCL's cannot be written, and remove its damaged entries, once in a process."""
    folder = compiler_cache()
    refused = _refused(folder)
    if refused is not None:
        places = (Path(parent) / f"flexgs-edge-{os.getuid()}" for parent in (tempfile.gettempdir(), SHARED_MEMORY))
        other = next((place for place in places if _refused(place) is None and _is_ours(place)), None)
        if other is None:
            LOG.warning("%s cannot be written (%s): PoCL needs a folder there, or one in %s", folder, refused, VARIABLE)
            return
        LOG.warning("%s cannot be written (%s): compiled kernels are kept in %s", folder, refused, other)
        os.environ[VARIABLE] = os.fspath(other)
        folder = other
    damaged = _damaged(folder)
    for entry in damaged:
        shutil.rmtree(folder / entry, ignore_errors=True)
    if damaged:
        LOG.warning("%s: %d damaged entries were removed; their kernels are compiled anew", folder, len(damaged))


def compiler_cache() -> Path:
    """Where PoCL keeps compiled kernels."""
    named = os.environ.get(VARIABLE)
    caches = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(named) if named else Path(caches) / "pocl" / "kcache"


def _refused(folder: Path) -> str | None:
    """Why files cannot be made in a folder; None if they can."""
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        with tempfile.TemporaryFile(dir=folder):
            return None
    except OSError as error:
        return error.strerror or str(error)


def _is_ours(folder: Path) -> bool:
    """Whether nobody else could have put programs there."""
    found = folder.lstat()
    return found.st_uid == os.getuid() and not found.st_mode & 0o022 and not folder.is_symlink()


def _damaged(folder: Path) -> set[Path]:
    """Entries, relative to the folder, with a file that is shorter than it states. Older files were looked at before."""
    stamp = folder / STAMP
    since = stamp.stat().st_mtime - FLUSHED if stamp.exists() else -1.0
    damaged = set()
    for place, _, names in os.walk(folder):
        for name in names:
            if name.endswith((".bc", ".so")) and not _is_whole(os.path.join(place, name), since):
                damaged.add(Path(*Path(place).relative_to(folder).parts[:2]))
    stamp.touch()
    return damaged


def _is_whole(path: str, since: float) -> bool:
    """Whether a library or a program in LLVM's bitcode has the length that it states, or is older than `since`."""
    try:
        found = os.stat(path)
        size = found.st_size
        if found.st_mtime < since:
            return True
        with open(path, "rb") as file:
            return _elf_bytes(file) <= size if path.endswith(".so") else _bitcode_bytes(file, size) == size
    except (OSError, struct.error):
        return False


def _elf_bytes(file: BinaryIO) -> int:
    """Where the table of sections of a library ends, which linkers write last; of a kind unknown here 1."""
    head = file.read(64)
    if not head.startswith(ELF):
        return 1
    (sections,) = struct.unpack_from("<Q", head, 40)
    size, count = struct.unpack_from("<HH", head, 58)
    return int(sections + size * count)


def _bitcode_bytes(file: BinaryIO, size: int) -> int:
    """Where the last block of a program ends; of a kind unknown here `size`."""
    if file.read(4) != BITCODE:
        return size or 1
    at = 4
    while at < size:
        file.seek(at + 4)
        (words,) = struct.unpack("<I", file.read(4))
        at += 8 + 4 * words
    return at
