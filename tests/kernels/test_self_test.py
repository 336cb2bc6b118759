"""The self-test: healthy kernels pass in every form, and a fault is named with its first wrong value."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from benchmarks.self_test import FORMS as RECORDED_FORMS
from benchmarks.self_test_faults import faults
from flexgs_edge.kernels.backend import CODEC_KERNELS, KERNELS
from flexgs_edge.kernels.cl_sources import KERNEL_DIR_VARIABLE, kernel_dir
from flexgs_edge.kernels.opencl import OpenCLBackend
from flexgs_edge.kernels.self_test import EXACT_ZEROS, Record, checksum, load_record, verdict
from kernel_fixtures import ALL_FORMS, FORMS, default_device, large_budget, open_form


@pytest.fixture(scope="module")
def record() -> Record:
    return load_record()


def test_every_kernel_is_in_it(record: Record) -> None:
    assert record.kernels == {*KERNELS, *CODEC_KERNELS} and set(RECORDED_FORMS) == {*FORMS, "fma"}
    assert all(step[4] for step in record.steps if step[0] == "launch" and step[1] in CODEC_KERNELS)


@pytest.mark.parametrize("form", [*ALL_FORMS, "fma"])
def test_every_form_passes(form: str, record: Record) -> None:
    """If the twins fail, results have changed on purpose: `python -m benchmarks.self_test record` makes a new record."""
    assert verdict(record, open_form(form)) == "ok"


def faulty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, file: str, old: str, new: str) -> OpenCLBackend:
    folder = tmp_path / "cl_kernels"
    shutil.copytree(kernel_dir(), folder)
    text = (folder / file).read_text()
    assert old in text
    (folder / file).write_text(text.replace(old, new))
    monkeypatch.setenv(KERNEL_DIR_VARIABLE, str(folder))
    return OpenCLBackend(default_device(), large_budget())


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        (
            "tiles.cl",
            "sum += bounds[ids[n]]",
            "sum += bounds[ids[n]] + 1u",
            ["kernel tile_room computes", "is right (element 0, the"],
        ),
        (
            "grid_rows.cl",
            "row[NORMAL_COLUMN + axis] = 0.0f",
            "row[NORMAL_COLUMN + axis] = -0.0f",
            ["kernel grid_rows", "-0 where 0"],
        ),
        ("activate.clh", "FW inv", "FW in v", ["kernel activate does not build", "error"]),
    ],
)
def test_a_fault_is_named(
    file: str, old: str, new: str, words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, record: Record
) -> None:
    said = verdict(record, faulty(tmp_path, monkeypatch, file, old, new))
    assert all(word in said for word in words) and "\n" not in said, said


def test_planted_faults(tmp_path: Path) -> None:
    """Each kernel has its faults, and planting one changes an operator."""
    planted = faults()
    assert {fault.file for fault in planted} == {path.name for path in kernel_dir().glob("*.cl*")}
    planted[0].plant(tmp_path / "copy")
    text, sound = ((folder / planted[0].file).read_text() for folder in (tmp_path / "copy", kernel_dir()))
    assert text != sound and abs(len(text) - len(sound)) <= 1


def test_kernels_are_named_before_they_are_built(record: Record) -> None:
    seen: list[str] = []
    verdict(record, open_form("w16"), seen.append)
    assert len(seen) == len(set(seen)) and set(seen) == {*KERNELS, *CODEC_KERNELS}


def test_records_survive_packing(record: Record) -> None:
    again = Record.unpack(record.pack())
    assert again.steps == record.steps
    assert all(
        a.dtype == b.dtype and a.tobytes() == b.tobytes() for a, b in zip(again.blobs, record.blobs, strict=True)
    )


def test_what_counts_as_equal() -> None:
    """Any NaN is like another. The sign of zero counts only where values are written to files."""
    plus, minus = np.array([0.0, np.nan], np.float32), np.array([-0.0, -np.nan], np.float32)
    assert checksum("blend", plus) == checksum("blend", minus)
    assert all(checksum(name, plus) != checksum(name, minus) for name in EXACT_ZEROS)
