"""The tests must be able to fail: a few faults planted in the kernels turn tests red (all of them: benchmarks/mutations.py)."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from benchmarks.mutations import kernel_folder, run_tests
from benchmarks.planted_faults import GOLDEN, MUTATIONS, Mutation

FEW = ("sign of the conic's B", "no near plane", "fused multiply-add in dequantize")
QUICK = {
    "sign of the conic's B": ("tests/render/test_render_reference.py", "test_tilts and w16 and inside"),
    "no near plane": ("tests/render/test_render_reference.py", "test_near_plane and w16"),
    "fused multiply-add in dequantize": ("tests/kernels/test_kernels_dequantize.py", "w16"),
}


@pytest.mark.parametrize("mutation", MUTATIONS, ids=lambda mutation: mutation.name)
def test_the_text_is_there(mutation: Mutation, tmp_path: Path) -> None:
    """Kernels change; a mutation whose text is gone would prove nothing."""
    assert kernel_folder(tmp_path, mutation).is_dir()


def test_constants_are_used(repository: Path) -> None:
    """A fault in a number that no kernel reads would prove nothing either."""
    kernels = "".join(path.read_text() for path in (repository / "cl_kernels").glob("*.cl*"))
    names = {name for mutation in MUTATIONS for name in re.findall(r"#define (\w+)", mutation.new)}
    assert names and not [name for name in names if not re.search(rf"\b{name}\b", kernels)]


def test_the_tests_are_there(repository: Path) -> None:
    files = {file for mutation in MUTATIONS for file in (*mutation.tests.reference, *mutation.tests.twins)}
    assert files and all((repository / file).is_file() for file in (*files, *GOLDEN))


@pytest.mark.parametrize("name", FEW)
def test_planted_faults_turn_tests_red(name: str, tmp_path: Path) -> None:
    (mutation,) = [mutation for mutation in MUTATIONS if mutation.name == name]
    file, keywords = QUICK[name]
    kernel_folder(tmp_path, mutation)
    assert run_tests(tmp_path, (file,), keywords) is not None


def test_healthy_kernels_stay_green(tmp_path: Path) -> None:
    """The same tests on a copy without a fault: it is the fault that they see."""
    kernel_folder(tmp_path, None)
    files = tuple({file: None for file, _ in QUICK.values()})
    keywords = " or ".join(f"({Path(file).stem} and {words})" for file, words in QUICK.values())
    assert run_tests(tmp_path, files, keywords) is None
