"""Use a device only after it has passed the self-test: once, in a process of its own, with the verdict kept."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace

from flexgs_edge.kernels.choose_device import DeviceInfo, choose_device, list_devices
from flexgs_edge.kernels.verdict import CACHE_VARIABLE, Verdict, keep_verdict, kept_verdict, key_of
from flexgs_edge.progress import LOG

CHILD = [sys.executable, "-m", "flexgs_edge.kernels.self_test_child"]
"""The command that tests one device. A compiler that crashes ends that process, not ours."""
MOST_SECONDS = 1800  # Time for the test of one device, with all kernels to build. The slowest that we met took 40 s.
MARK = "self-test: "  # Begins the lines of `CHILD` that are for us; runtimes print other ones
FORM = "form "  # Begins what such a line says when another form of the kernels begins; other lines name kernels

_known: dict[str, Verdict] = {}
_warned: set[str] = set()


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
