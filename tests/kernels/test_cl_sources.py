"""Where the OpenCL sources are found, and the constants printed above them."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexgs_edge import constants
from flexgs_edge.errors import DeviceError
from flexgs_edge.kernels.cl_sources import (
    KERNEL_DIR_VARIABLE,
    constants_header,
    float_literal,
    integer_literal,
    kernel_dir,
    load_source,
)


@pytest.fixture(autouse=True)
def no_override(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(KERNEL_DIR_VARIABLE, raising=False)


@given(st.floats(width=32, allow_nan=False, allow_infinity=False))
def test_a_float_literal_reads_back_to_the_same_bits(value: float) -> None:
    text = float_literal(value)
    digits = re.fullmatch(r"\(?(-?[0-9.]+(?:e[+-][0-9]+)?)f\)?", text)
    assert digits is not None and ("." in text or "e" in text), text
    assert np.float32(float(digits.group(1))).tobytes() == np.float32(value).tobytes()
    assert text.startswith("(") == (text[1:2] == "-"), "a - NAME must not become --"


@pytest.mark.parametrize(("value", "text"), [(0, "0"), (-1, "(-1)"), (2**31 - 1, "2147483647"), (2**31, "2147483648u")])
def test_integer_literals(value: int, text: str) -> None:
    assert integer_literal(value) == text


@pytest.mark.parametrize("value", [-(2**31) - 1, 2**32])
def test_an_integer_of_more_than_32_bits_is_refused(value: int) -> None:
    with pytest.raises(ValueError, match=str(value)):
        integer_literal(value)


def test_the_header_holds_every_number_once() -> None:
    lines = [line.split(maxsplit=2) for line in constants_header().splitlines()]
    assert all(define == "#define" for define, _, _ in lines)
    names = [name for _, name, _ in lines]
    assert len(set(names)) == len(names)
    printed = dict(line[1:] for line in lines)
    assert printed["TILE"] == "16"
    assert printed["SH_C2_1"] == float_literal(constants.SH_C2[1])
    assert printed["EXP2_POLY_5"] == float_literal(constants.EXP2_POLY[5])
    assert f"EXP2_POLY_{len(constants.EXP2_POLY)}" not in printed


def test_every_kernel_file_is_completed(repository: Path) -> None:
    files = sorted(path.name for path in (repository / "cl_kernels").glob("*.cl"))
    assert files
    for name in files:
        source = load_source(name)
        marks = re.findall(r'^#line 1 "(.*)"$', source, re.MULTILINE)
        assert marks[1] == "common.clh" and name in marks
        repeated = {mark for mark in marks if marks.count(mark) > 1}
        assert repeated <= {"blend_cpu.cl"}  # once for each kind
        assert source.index("#pragma OPENCL FP_CONTRACT OFF") < source.index(f'#line 1 "{name}"')


def test_the_override_wins_and_must_hold_kernels(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert kernel_dir() == repository / "cl_kernels"
    monkeypatch.setenv(KERNEL_DIR_VARIABLE, str(tmp_path))
    with pytest.raises(DeviceError, match=f"{re.escape(str(tmp_path))}.*{KERNEL_DIR_VARIABLE}"):
        kernel_dir()
    for file in (repository / "cl_kernels").glob("*.cl*"):
        shutil.copy(file, tmp_path)
    (tmp_path / "project.cl").write_text("// planted\n")
    assert '#line 1 "project.cl"\n// planted\n\n' in load_source("project.cl")


def test_a_missing_file_is_named() -> None:
    with pytest.raises(DeviceError, match=r"no_such_kernel\.cl: No such file"):
        load_source("no_such_kernel.cl")
