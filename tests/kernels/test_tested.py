"""Verdicts: a device is tested once, in a process of its own, and refused if that goes wrong in any way."""

from __future__ import annotations

import errno
import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from flexgs_edge.cli import app
from flexgs_edge.errors import BudgetError, DeviceError
from flexgs_edge.kernels import opencl as programs
from flexgs_edge.kernels import tested as module
from flexgs_edge.kernels import tested as verdicts
from flexgs_edge.kernels.choose_device import DeviceInfo, choose_device, list_devices
from flexgs_edge.kernels.opencl import OpenCLBackend
from flexgs_edge.kernels.tested import (
    FORM,
    MARK,
    choose_tested,
    list_with_verdicts,
    processors_with_verdicts,
    with_verdict,
)
from kernel_fixtures import default_device, large_budget

GOOD = {"self_test": "ok", "loop_steps": 0, "form": "cpu16"}
CRASH = "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)"


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """No verdict yet, and a cache folder of the test's own."""
    monkeypatch.setattr(module, "_known", {})
    monkeypatch.setattr(module, "_warned", set())
    monkeypatch.setenv(verdicts.CACHE_VARIABLE, str(tmp_path / "cache"))
    return tmp_path / "cache" / "devices"


def child(monkeypatch: pytest.MonkeyPatch, code: str) -> None:
    """Let this code test devices."""
    monkeypatch.setattr(module, "CHILD", [sys.executable, "-c", code])


def says(verdict: dict[str, Any], kernel: str = "blend") -> str:
    return f"print({MARK + kernel!r}); print('noise'); print({MARK + json.dumps(verdict)!r})"


@pytest.fixture
def info() -> DeviceInfo:
    return replace(default_device(), self_test="not run", context=None)


def test_this_machine_has_a_device_that_passes(own_cache: Path) -> None:
    info, _ = choose_tested(None)
    assert info.self_test == "ok"
    kept = [json.loads(path.read_text()) for path in own_cache.iterdir()]
    assert {"self_test": "ok", "name": info.name}.items() <= kept[0].items() and len(kept) == 1


def test_a_verdict_is_kept(info: DeviceInfo, monkeypatch: pytest.MonkeyPatch) -> None:
    child(monkeypatch, says({"self_test": "ok", "loop_steps": 65535, "form": "gpu4"}))
    assert with_verdict(info).loop_steps == 65535
    child(monkeypatch, CRASH)
    assert with_verdict(info).usable
    monkeypatch.setattr(module, "_known", {})  # as in another process
    assert with_verdict(info) == replace(info, self_test="ok", loop_steps=65535, form="gpu4")
    assert not with_verdict(info, anew=True).usable and not with_verdict(info).usable
    child(monkeypatch, says(GOOD))
    assert with_verdict(info, anew=True).usable


def test_kernels_and_drivers_have_verdicts_of_their_own(
    info: DeviceInfo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys = {
        verdicts.key_of(info),
        verdicts.key_of(replace(info, driver="2")),
        verdicts.key_of(replace(info, platform="x")),
    }
    folder = tmp_path / "kernels"
    folder.mkdir()
    (folder / "common.clh").write_text("// other kernels")
    monkeypatch.setenv("FLEXGS_KERNEL_DIR", str(folder))
    assert len({*keys, verdicts.key_of(info)}) == 4
    assert verdicts.key_of(info) == verdicts.key_of(replace(info, index=7, global_bytes=1))


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (
            f"print({MARK + 'project'!r}, flush=True); {CRASH}",
            ["signal 11, SIGSEGV", "building or running kernel project"],
        ),
        (
            "import sys; print('InvalidFunctionCall', file=sys.stderr); sys.exit(8)",
            ["exit code 8", "before the first", "last words: Inv"],
        ),
        ("pass", ["exit code 0", "before the first kernel"]),
    ],
)
def test_a_compiler_that_ends_the_process(
    code: str, words: list[str], info: DeviceInfo, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit code 4 and one error, and the process that wanted the device lives."""
    child(monkeypatch, code)
    with pytest.raises(SystemExit) as left:
        app.main(["devices", "--device", str(info.index), "-q"])
    said = capsys.readouterr().err
    assert left.value.code == 4 and said.count("error:") == 1 and "Traceback" not in said
    assert all(word in said for word in [*words, "devices --self-test", "--device numpy"])


def test_testing_anew(info: DeviceInfo, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """`devices` believes what it knows; `devices --self-test` does not."""
    monkeypatch.setattr(module, "list_devices", lambda self_test: [info])

    def devices(*arguments: str) -> tuple[object, str]:
        with pytest.raises(SystemExit) as left:
            app.main(["devices", *arguments])
        return left.value.code, capsys.readouterr().err

    child(monkeypatch, says(GOOD))
    assert devices()[0] == 0
    child(monkeypatch, CRASH)
    assert devices()[0] == 0
    code, said = devices("--self-test")
    assert code == 4 and "SIGSEGV" in said and "chosen:" not in said
    assert devices()[0] == 4  # the newest verdict holds


def test_a_form_that_ends_the_process(info: DeviceInfo, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is left out, and the others are tried."""
    crash = f"print({MARK + FORM!r} + form, flush=True); {CRASH}"
    code = f"import os, signal, sys\nform = 'gpu1'\nif form not in sys.argv: {crash}\nelse: {says(GOOD)}"
    child(monkeypatch, code)
    assert with_verdict(info) == replace(info, self_test="ok", form="cpu16")
    nothing = says({"self_test": "", "loop_steps": 0, "form": ""})
    child(monkeypatch, code.replace(says(GOOD), nothing))
    assert "SIGSEGV), building or running form gpu1" in with_verdict(info, anew=True).self_test
    child(monkeypatch, crash.replace("+ form", "+ 'cpu1'").replace("print", "import os, signal; print", 1))
    assert "SIGSEGV), building or running form cpu1" in with_verdict(info, anew=True).self_test  # though left out


def test_a_test_that_does_not_end(info: DeviceInfo, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_SECONDS", 0.3)
    child(monkeypatch, f"import time; print({MARK + 'sort_count'!r}, flush=True); time.sleep(60)")
    assert "did not end within 0.3 s" in with_verdict(info).self_test


def test_wrong_devices_are_passed_over(monkeypatch: pytest.MonkeyPatch, info: DeviceInfo) -> None:
    """The next one is tested and taken, unless the user named the one that fails."""
    gpu = replace(info, index=1, name="MethodResult up", type="gpu")
    monkeypatch.setattr(module, "list_devices", lambda self_test: [info, gpu])
    bad = says({"self_test": "kernel x computes 1", "loop_steps": 0, "form": ""})
    code = f"import sys\nif sys.argv[1] == '1': {bad}\nelse: {says(GOOD)}"
    child(monkeypatch, code)
    assert choose_tested(None)[0] == replace(info, self_test="ok", form="cpu16")
    with pytest.raises(DeviceError, match="--device gpu: failed the self-test.*kernel x computes 1"):
        choose_tested("gpu")
    assert [found.usable for found in list_with_verdicts()] == [True, False]
    assert [found.index for found in processors_with_verdicts()] == [0]


@pytest.mark.parametrize("fault", ["full", "read-only", "a file"])
def test_a_cache_that_takes_nothing(
    fault: str, own_cache: Path, info: DeviceInfo, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The device is used all the same, and one warning says what is lost, and how to mend it."""
    if fault == "full":

        def replace_(*paths: object) -> None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        monkeypatch.setattr(os, "replace", replace_)
    elif fault == "read-only":

        def mkstemp(**_: object) -> None:
            raise OSError(errno.EROFS, os.strerror(errno.EROFS))

        monkeypatch.setattr(verdicts.tempfile, "mkstemp", mkstemp)
    else:
        own_cache.parent.write_text("not a folder")
    child(monkeypatch, says(GOOD))
    monkeypatch.setattr(module.LOG, "handlers", [caplog.handler])
    monkeypatch.setattr(module.LOG, "propagate", False)
    assert with_verdict(info).usable and with_verdict(info, anew=True).usable
    warnings = [entry.getMessage() for entry in caplog.records if entry.levelname == "WARNING"]
    assert len(warnings) == 1 and str(own_cache) in warnings[0] and "FLEXGS_CACHE_DIR" in warnings[0]
    assert fault == "a file" or list(own_cache.iterdir()) == []


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        '{"self_test": 3, "loop_steps": 0, "form": ""}',
        '{"self_test": "ok"}',
        '{"self_test": "ok", "loop_steps": 0, "form": 4}',
    ],
)
def test_a_damaged_verdict_is_none(text: str, own_cache: Path, info: DeviceInfo) -> None:
    own_cache.mkdir(parents=True)
    (own_cache / f"{verdicts.key_of(info)}.json").write_text(text)
    assert verdicts.kept_verdict(verdicts.key_of(info)) is None


def test_a_device_that_vanishes(info: DeviceInfo) -> None:
    assert "the device is gone: [77] is no longer" in with_verdict(replace(info, index=77, driver="gone")).self_test
    assert "the device is gone" in with_verdict(replace(info, name="another", driver="gone")).self_test


def test_a_device_that_fails_in_a_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """Errors of the runtime name the device and what it did, and have exit codes."""
    import pyopencl as cl

    session = OpenCLBackend(default_device(), large_budget())
    array = session.array((4,), "f4")

    def fails(kind: type[cl.Error], routine: str) -> Any:
        def call(*_: Any, **__: Any) -> None:
            raise kind(routine, cl.status_code.OUT_OF_RESOURCES, "no device")

        return call

    with pytest.raises(DeviceError, match="failed while running kernel blend .*devices --self-test"):
        session.enqueue("blend", fails(cl.RuntimeError, "clEnqueueNDRangeKernel"), (1,), (1,), ())
    with pytest.raises(BudgetError, match="ran out of memory while running kernel blend"):
        session.enqueue("blend", fails(cl.MemoryError, "clEnqueueNDRangeKernel"), (1,), (1,), ())
    with monkeypatch.context() as patch:
        patch.setattr(cl, "enqueue_copy", fails(cl.LogicError, "clEnqueueReadBuffer"))
        for call in (lambda: session.read(array), lambda: session.write(array, [1, 2, 3, 4])):  # type: ignore[arg-type]
            with pytest.raises(DeviceError, match=f"{re.escape(default_device().name)}.* failed while"):
                call()
        patch.setattr(programs, "_CONTEXTS", {})
        patch.setattr(cl, "Context", fails(cl.RuntimeError, "clCreateContext"))
        with pytest.raises(DeviceError, match="does not open"):
            OpenCLBackend(replace(default_device(), context=None), large_budget())
    array.release()


def test_a_runtime_whose_library_is_missing(tmp_path: Path, info: DeviceInfo, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "gone.icd").write_text("/nowhere/libgone.so.1\n")
    environment = {
        **os.environ,
        "OCL_ICD_VENDORS": str(tmp_path),
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
    }
    done = subprocess.run(
        [sys.executable, "-m", "flexgs_edge", "devices"],
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 4 and "Traceback" not in done.stderr
    with monkeypatch.context() as patch:  # beside one that works
        patch.setenv("OCL_ICD_VENDORS", str(tmp_path))
        with pytest.raises(DeviceError, match=r"no such OpenCL device \(.*gone.icd names .*; there are: \[0\]"):
            choose_device("gone", [info])
    assert (
        "gone.icd names /nowhere/libgone.so.1, which cannot be loaded" in done.stderr
        and "pocl-opencl-icd" in done.stderr
    )


def test_two_platforms_of_one_name(info: DeviceInfo) -> None:
    """A name takes the first and says so; a number tells them apart."""
    twins = [replace(info, index=index, self_test="ok") for index in range(2)]
    chosen, why = choose_device(info.platform, twins)
    assert chosen is twins[0] and "the first of 2 that match, --device 1 for others" in why
    assert choose_device("1", twins)[0] is twins[1]


def test_listing_alone_tests_nothing() -> None:
    assert {found.self_test for found in list_devices(self_test=False)} == {"not run"}
