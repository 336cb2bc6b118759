"""Forms of the kernels: which ones a device can take, which is measured to be fastest, and that a verdict decides."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import pyopencl as cl
import pytest

from flexgs_edge.errors import DeviceError
from flexgs_edge.kernels import self_test_child
from flexgs_edge.kernels.choose_device import DeviceInfo, Form, likely_form, possible_forms
from flexgs_edge.kernels.opencl import OpenCLBackend
from flexgs_edge.kernels.self_test_child import Measured, may_write_fma, measure_forms
from kernel_fixtures import default_device, large_budget

CPU = DeviceInfo(0, "a", "b", "cpu", "1", "OpenCL C 1.2", 2, 8, 4096, 1 << 15, 1 << 32, 1 << 30, "ok")
GPU = replace(CPU, type="gpu", native_width=1)


@pytest.mark.parametrize(
    ("info", "names"),
    [
        (CPU, ["cpu8", "gpu1", "gpu4"]),
        (GPU, ["gpu1", "gpu4", "cpu1"]),
        (replace(CPU, loop_steps=65535), ["gpu1", "gpu4"]),
        (replace(GPU, max_work_group=64), ["gpu4", "cpu1"]),
    ],
)
def test_possible_forms(info: DeviceInfo, names: list[str]) -> None:
    assert [str(form) for form in possible_forms(info)] == names
    assert all(Form.named(name) is not None and str(Form.named(name)) == name for name in [*names, "gpu4+fma"])


def test_the_kept_form_is_taken() -> None:
    """Without a measured one, the type decides; what a caller asks for comes first."""

    def opened(name: str, **wish: Any) -> tuple[str, int, bool]:
        backend = OpenCLBackend(replace(default_device(), form=name), large_budget(), **wish)
        return backend.form, backend.width, backend.written_fma

    likely = likely_form(default_device())
    assert opened("") == opened("of another version") == (likely.kind, likely.width, False)
    assert opened("gpu4+fma") == ("gpu", 4, True)
    assert opened("gpu4+fma", form="cpu", width=8, written_fma=False) == ("cpu", 8, False)
    assert opened("cpu16", form="gpu") == ("gpu", 1, False)
    described = OpenCLBackend(replace(default_device(), form="gpu4"), large_budget()).describe()
    assert described["form"] == "gpu" and described["width"] == 4


def test_forms_are_measured() -> None:
    """PoCL's processors are known to be fastest in their own form, by far."""
    said: list[str] = []
    measured, failed = measure_forms(default_device(), say=said.append)
    assert sorted(str(one.form) for one in measured) == sorted(said) and not failed
    assert [one.seconds for one in measured] == sorted(one.seconds for one in measured)
    if default_device().type == "cpu":
        assert measured[0].form == likely_form(default_device())
    left, _ = measure_forms(default_device(), without=said[:1])
    assert {str(one.form) for one in left} == set(said[1:])


def device_with(flags: int) -> DeviceInfo:
    return replace(GPU, handle=SimpleNamespace(single_fp_config=flags))  # type: ignore[arg-type]


def test_fma_is_written_out_only_where_the_device_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """And no subnormal numbers either; and the slow one of the two is built once."""
    flags = cl.device_fp_config
    assert may_write_fma(device_with(flags.ROUND_TO_NEAREST)) and not may_write_fma(GPU)
    assert not may_write_fma(device_with(flags.FMA)) and not may_write_fma(device_with(flags.DENORM))

    def backend(info: DeviceInfo, budget: object) -> Form:
        form = Form.named(info.form)
        if form is None or form.kind == "cpu":
            raise DeviceError("the compiler refuses it")
        return form

    def seconds(faster: bool, form: Form) -> float:
        return 1 / form.width + (form.written_fma is not faster)

    monkeypatch.setattr(self_test_child, "OpenCLBackend", backend)
    for faster, names in ((True, ["gpu4+fma", "gpu1+fma", "gpu1"]), (False, ["gpu4", "gpu1", "gpu1+fma"])):
        monkeypatch.setattr(self_test_child, "_seconds", partial(seconds, faster))
        measured, failed = measure_forms(device_with(flags.INF_NAN))
        assert [str(one.form) for one in measured] == names and failed == "the compiler refuses it"


def test_the_fastest_form_that_is_right_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """A device is refused only if no form gives the right bits."""
    forms = [Form("gpu", 4), Form("gpu", 1), Form("cpu", 16)]
    said = {"gpu4": "kernel blend computes 1", "gpu1": "kernel blend computes 2", "cpu16": "ok"}

    def measure(info: DeviceInfo, without: list[str], say: object) -> tuple[list[Measured], str]:
        return [Measured(f, f, 1.0) for f in forms if str(f) not in without], "does not build"  # type: ignore[arg-type]

    monkeypatch.setattr(self_test_child, "measure_forms", measure)
    monkeypatch.setattr(self_test_child, "verdict", lambda record, backend, say: said[str(backend)])
    index, name = default_device().index, default_device().name
    found = self_test_child.test(index, name)
    assert found.self_test == "ok" and found.form == "cpu16"
    refused = self_test_child.test(index, name, ["cpu16"])
    assert refused.self_test == "kernel blend computes 1" and refused.form == ""
    assert self_test_child.test(index, name, list(said)).self_test == "does not build"
    monkeypatch.setattr(self_test_child, "measure_forms", lambda info, without, say: ([], ""))
    assert self_test_child.test(index, name).self_test == ""
