"""Open a backend. A device is used only after it has passed the self-test: once, in a process of its own.

A run opens one by `counted_backend`, which counts its memory.
"""

import hashlib
import json
import os
import signal
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from flexgs_edge.kernels.backend import Backend, TwinBackend
from flexgs_edge.kernels.choose_device import SELF_TEST, DeviceInfo, choose_device, list_devices
from flexgs_edge.kernels.cl_sources import constants_header, kernel_dir
from flexgs_edge.kernels.self_test import RECORD
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.memory.process import current_rss
from flexgs_edge.progress import LOG, Stopwatch

CHILD = [sys.executable, "-m", "flexgs_edge.kernels.self_test_child"]
"""The command that tests one device. A compiler that crashes ends that process, not ours."""
MOST_SECONDS = 1800  # Time for the test of one device, with all kernels to build. The slowest that we met took 40 s.
MARK = "self-test: "  # Begins the lines of `CHILD` that are for us; runtimes print other ones
FORM = "form "  # Begins what such a line says when another form of the kernels begins; other lines name kernels

_known: "dict[str, Verdict]" = {}
_warned: set[str] = set()
CACHE_VARIABLE = "FLEXGS_CACHE_DIR"  # Environment variable with another folder for what we keep between runs
_ABOUT = ("name", "platform", "driver", "opencl_c", "type", "native_width", "max_work_group", "local_bytes")
RUNTIME_BYTES = 88 * 2**20
"""Bound on what PoCL's runtime and its compiler take before our kernels are built. Once the device is open, it is known."""
BUILD_BYTES = 24 * 2**20
"""Bound on the bytes that building our kernels adds to the loaded compiler: docs/results/tuning.md#memory"""


@dataclass(frozen=True)
class Verdict:
    """What the self-test said: `DeviceInfo.self_test`, `DeviceInfo.loop_steps` and `DeviceInfo.form`."""

    self_test: str
    loop_steps: int = 0
    form: str = ""


def cache_folder() -> Path:
    """Where verdicts lie: `devices` in FLEXGS_CACHE_DIR, or in `flexgs-edge` of the user's cache folder."""
    named = os.environ.get(CACHE_VARIABLE)
    if named:
        return Path(named) / "devices"
    caches = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(caches) / "flexgs-edge" / "devices"


def key_of(info: DeviceInfo) -> str:
    """A name for the device, its driver, our kernels and the self-test together; any change gives another one."""
    digest = hashlib.sha256(json.dumps([getattr(info, name) for name in _ABOUT]).encode())
    for text in (SELF_TEST, constants_header()):
        digest.update(text.encode())
    for file in sorted(kernel_dir().glob("*.cl*")):
        digest.update(file.name.encode() + file.read_bytes())
    digest.update(RECORD.read_bytes())
    return digest.hexdigest()[:32]


def kept_verdict(key: str) -> Verdict | None:
    """The verdict of an earlier run; None if there is none, or if its file cannot be read."""
    try:
        found = json.loads((cache_folder() / f"{key}.json").read_text(encoding="utf-8"))
        verdict = Verdict(found["self_test"], found["loop_steps"], found["form"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    sound = isinstance(verdict.self_test, str) and isinstance(verdict.form, str) and type(verdict.loop_steps) is int
    return verdict if sound else None


def keep_verdict(key: str, info: DeviceInfo, verdict: Verdict) -> str | None:
    """Keep a verdict for later runs. Returns None, or why that was not possible."""
    about: dict[str, Any] = {name: getattr(info, name) for name in _ABOUT}
    folder = cache_folder()
    temporary = None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(prefix=f"{key}.", dir=folder)
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            json.dump({**asdict(verdict), **about}, file, indent=1)
        os.replace(temporary, folder / f"{key}.json")
    except OSError as error:
        if temporary is not None and os.path.exists(temporary):
            os.unlink(temporary)
        return f"{folder}: {error.strerror or error}"
    return None


def with_verdict(info: DeviceInfo, anew: bool = False) -> DeviceInfo:
    """`info` with the verdict of the self-test: a kept one, or that of a test made now.

    `anew`: test the device even if there is a verdict.
    """
    key = key_of(info)
    verdict = None if anew else _known.get(key) or kept_verdict(key)
    if verdict is None:
        LOG.info("testing %s (%s) with all kernels; the verdict is kept", info.name, info.platform)
        verdict = _test_in_child(info)
        refused = keep_verdict(key, info, verdict)
        if refused is not None and refused not in _warned:
            _warned.add(refused)
            LOG.warning(
                "the verdict of the self-test cannot be kept (%s), so every start tests the device again; "
                "name a folder in %s",
                refused,
                CACHE_VARIABLE,
            )
    _known[key] = verdict
    return replace(info, self_test=verdict.self_test, loop_steps=verdict.loop_steps, form=verdict.form)


def choose_tested(spec: str | None) -> tuple[DeviceInfo, str]:
    """Choose a device as `choose_device` does, and test those that are in question, one after the other.

    Raises `DeviceError`: As `choose_device`.
    """
    devices = list_devices(self_test=False)
    while True:
        info, reason = choose_device(spec, devices)
        if info.self_test != "not run":
            return info, reason
        devices[info.index] = with_verdict(info)


def list_with_verdicts(anew: bool = False) -> list[DeviceInfo]:
    """Every device of this machine with its verdict."""
    return [with_verdict(info, anew) for info in list_devices(self_test=False)]


def processors_with_verdicts() -> list[DeviceInfo]:
    """Every processor of this machine with its verdict."""
    return [with_verdict(info) for info in list_devices(self_test=False) if info.type == "cpu"]


def _test_in_child(info: DeviceInfo) -> Verdict:
    """The verdict of `CHILD`. A form of the kernels that ends its process is left out, and the others are tested."""
    first = None
    without: list[str] = []
    while True:
        verdict, form = _run_child(info, without)
        if form is None or form in without:
            return verdict if verdict.self_test or first is None else first
        first = first or verdict
        without.append(form)


def _run_child(info: DeviceInfo, without: list[str]) -> tuple[Verdict, str | None]:
    """A verdict, and the form that ended the process; None if none did."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    try:
        done = subprocess.run(
            [*CHILD, str(info.index), info.name, *without],
            env=environment,
            capture_output=True,
            timeout=MOST_SECONDS,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        return Verdict(f"the self-test did not end within {MOST_SECONDS} s{_at(error.stdout or b'')}"), None
    lines = _lines(done.stdout)
    if done.returncode == 0 and lines and lines[-1].startswith("{"):
        said = json.loads(lines[-1])
        return Verdict(said["self_test"], said["loop_steps"], said["form"]), None
    words = [line.strip() for line in done.stderr.decode(errors="replace").splitlines() if line.strip()]
    last = f"; its last words: {words[-1][:200]}" if words else ""
    how = f"the runtime ended the process of the self-test ({_how(done.returncode)}){_at(done.stdout)}{last}"
    forms = [line.removeprefix(FORM) for line in lines if line.startswith(FORM)]
    return Verdict(how), forms[-1] if forms else None


def _lines(output: bytes) -> list[str]:
    text = output.decode(errors="replace")
    return [line[len(MARK) :] for line in text.splitlines() if line.startswith(MARK)]


def _at(output: bytes) -> str:
    kernels = [line for line in _lines(output) if not line.startswith("{")]
    if not kernels:
        return ", before the first kernel"
    return f", building or running {kernels[-1] if kernels[-1].startswith(FORM) else f'kernel {kernels[-1]}'}"


def _how(code: int) -> str:
    if code >= 0:
        return f"exit code {code}"
    try:
        return f"signal {-code}, {signal.Signals(-code).name}"
    except ValueError:
        return f"signal {-code}"


def open_backend(device: str | None, budget: MemoryBudget) -> Backend:
    """Open the backend that `device` names.

    `device`: `numpy` for the twins, else an OpenCL device as in `flexgs_edge.kernels.choose_device.choose_device`. We
    never fall back from one to the other silently. `budget`: counts every array of the backend. Raises `DeviceError` if
    the device does not exist, or failed its self-test.
    """
    if device == "numpy":
        return TwinBackend(budget)
    from flexgs_edge.kernels.opencl import OpenCLBackend

    info, _ = choose_tested(device)
    return OpenCLBackend(info, budget)


def counted_backend(device: str | None, budget: MemoryBudget, clock: Stopwatch) -> Backend:
    """Open the backend that `device` names, as the stage `device`, and take its runtime's memory from the budget."""
    budget.require("the program", 0)  # whose size is known by now
    before = current_rss()
    with clock.stage("device"):
        backend = open_backend(device, budget)
    if not backend.is_numpy and not budget.runtime:
        # The runtime and its compiler stay loaded. They take more memory when no kernels are cached.
        budget.runtime = max(current_rss() - before, 0) + BUILD_BYTES
        budget.take("the OpenCL runtime", budget.runtime)
    return backend
