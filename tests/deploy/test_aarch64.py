"""Every runtime dependency, extras for users included, has a wheel for aarch64 Linux; and the script that says so can fail."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from packaging.utils import canonicalize_name

NO_INDEX = (
    "No matching distribution found for",
    "Could not fetch URL",
    "Connection",
    "Temporary failure",
    "Network is",
)


@pytest.fixture(scope="module")
def script(repository: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("check_aarch64", repository / "deploy" / "check-aarch64.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def has_index() -> bool:
    """Whether pip can fetch anything here (a wheel that every index has, for this machine)."""
    command = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--dry-run",
        "--ignore-installed",
        "--no-deps",
        "click",
    ]
    return subprocess.run(command, capture_output=True, check=False, timeout=120).returncode == 0


def test_all_dependencies_resolve(repository: Path, script: ModuleType) -> None:
    command = [sys.executable, str(repository / "deploy" / "check-aarch64.py"), "3.10", "3.11", "3.12"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=240)
    if done.returncode and any(words in done.stderr for words in NO_INDEX) and not has_index():
        pytest.skip("pip reaches no package index")
    assert done.returncode == 0, done.stderr
    for version in ("3.10", "3.11", "3.12"):
        line = next(line for line in done.stdout.splitlines() if f"Python {version}:" in line)
        for name in sorted(canonicalize_name(r.name) for r in script.runtime_requirements()):
            assert f" {name} " in line.lower(), f"{name} is missing in: {line}"


def chosen(file: str, requires_python: str = ">=3.8", requires: tuple[str, ...] = ()) -> dict[str, Any]:
    name = file.split("-")[0]
    metadata = {"name": name, "version": "1", "requires_python": requires_python, "requires_dist": list(requires)}
    return {"metadata": metadata, "download_info": {"url": f"https://index.example/{file}"}}


@pytest.mark.parametrize(
    ("item", "words"),
    [
        (chosen("a-1-cp310-cp310-manylinux2014_aarch64.whl"), None),
        (chosen("a-1-py3-none-any.whl"), None),
        (chosen("a-1-cp310-cp310-manylinux2014_x86_64.whl"), "no wheel for aarch64"),
        (chosen("a-1.tar.gz"), "no wheel for aarch64"),
        (chosen("a-1-py3-none-any.whl", ">=3.11"), "requires Python >=3.11"),
        (chosen("a-1-py3-none-any.whl", ">=3.8,<3.10"), "requires Python"),
    ],
)
def test_files_that_would_not_install(script: ModuleType, item: dict[str, Any], words: str | None) -> None:
    found = script.faults(item, "3.10")
    assert not found if words is None else words in found[0]


def test_markers_are_read_for_the_target(script: ModuleType) -> None:
    requires = (
        'old; python_version < "3.11"',
        'new>=2; python_version >= "3.11"',
        'x86; platform_machine == "x86_64"',
        "there",
    )
    items = [chosen("a-1-py3-none-any.whl", requires=requires), chosen("There-1-py3-none-any.whl")]
    assert script.missing(items, "3.10") == ["old"]
    assert script.missing(items, "3.12") == ["new>=2"]


def test_versions_are_those_of_the_tests(script: ModuleType) -> None:
    names = {r.name for r in script.runtime_requirements()}
    assert names >= {"numpy", "pyopencl", "plyfile", "pillow", "click", "tqdm", "zstandard"}
    assert not names & {"pytest", "ruff", "torch"}
    for version in script.VERSIONS:
        names = [line.split("==")[0] for line in script.constraints(version)]
        assert len(names) == len(set(names)) and "numpy" in names
        assert ("exceptiongroup" in names) == (version == "3.10")
