"""The house rules that a machine can check: import order, lazy imports, module length."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

LONGEST_MODULE = 450
HEAVY = ("pyopencl", "skimage", "scipy", "matplotlib", "plyfile", "PIL", "tqdm", "jinja2", "markupsafe", "minify")


def lint_imports(folder: Path, contract: str | None = None) -> subprocess.CompletedProcess[str]:
    """Check the import contracts (or the one of this id) of the checkout in `folder`."""
    only = ["--contract", contract] if contract else []
    return subprocess.run(
        [
            sys.executable,
            "-c",
            "from importlinter.cli import lint_imports_command as lint; lint()",
            "--no-cache",
            *only,
        ],
        cwd=folder,
        # Before any installed copy, so that the planted faults below are what is read.
        env={**os.environ, "PYTHONPATH": str(folder)},
        capture_output=True,
        text=True,
        check=False,
    )


def test_import_contracts_hold(repository: Path) -> None:
    result = lint_imports(repository)
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.fixture(scope="module")
def copy(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("planted")
    shutil.copy(repository / "setup.cfg", folder)
    shutil.copytree(repository / "flexgs_edge", folder / "flexgs_edge", ignore=shutil.ignore_patterns("__pycache__"))
    return folder


@pytest.mark.parametrize(
    ("contract", "module", "statement"),
    [
        ("layers", "errors.py", "import flexgs_edge.cli"),
        ("layers", "scene/fields.py", "from flexgs_edge.cameras.camera import Camera"),
        ("layers", "kernels/cl_sources.py", "from flexgs_edge.render import renderer"),
        ("layers", "commands/trim.py", "import flexgs_edge.api.fgs_file"),
        ("layers", "attic.py", "A_MODULE = 'that nobody gave a floor'"),
        ("methods", "methods/best/poses.py", "import flexgs_edge.methods.paper.method"),
        ("codec", "codec/v1/container.py", "import flexgs_edge.codec.v2.header"),
        ("codec_v2", "codec/v2/tables.py", "import flexgs_edge.codec.v2.walk"),
        ("views", "views/references.py", "import flexgs_edge.views.sums"),
        ("render", "render/fit.py", "import flexgs_edge.render.chunks"),
        ("bytes", "io/ply.py", "import flexgs_edge.quality.psnr"),
        ("goals", "goals/choice.py", "import numpy"),
        ("fit", "render/fit.py", "import flexgs_edge.memory.budget"),
        ("studies", "cli/app.py", "import flexgs_edge.studies.page"),
        ("opencl", "kernels/twins/sort.py", "import pyopencl"),
        ("opencl", "scene/source.py", "import flexgs_edge.kernels.opencl"),  # through a third module
        ("plyfile", "cameras/read.py", "def late() -> None:\n    import plyfile"),
        ("plots", "studies/written.py", "import matplotlib"),
        ("pages", "run/reporter.py", "def late() -> None:\n    import jinja2"),
        ("pages", "studies/page.py", "import markupsafe"),
    ],
)
def test_a_planted_violation_is_seen(copy: Path, contract: str, module: str, statement: str) -> None:
    path = copy / "flexgs_edge" / module
    original = path.read_text() if path.exists() else ""
    assert not original or lint_imports(copy, contract).returncode == 0, "the contract was broken before"
    path.write_text(f"{original}\n{statement}\n")
    try:
        result = lint_imports(copy, contract)
    finally:
        path.write_text(original) if original else path.unlink()
    assert result.returncode == 1, result.stdout + result.stderr
    dotted = f"flexgs_edge.{module.removesuffix('.py').removesuffix('/__init__').replace('/', '.')}"
    assert dotted in result.stdout


def modules_after(statement: str, repository: Path) -> set[str]:
    """Top-level modules that a fresh interpreter has loaded after `statement`."""
    script = f"import sys\n{statement}\nprint(*{{name.partition('.')[0] for name in sys.modules}}, file=sys.stderr)"
    result = subprocess.run([sys.executable, "-c", script], cwd=repository, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    return set(result.stderr.split())


@pytest.mark.parametrize(
    ("statement", "absent"),
    [
        ("import flexgs_edge", HEAVY),
        ("from flexgs_edge.cli.app import main\ntry: main(['--help'])\nexcept SystemExit: pass", HEAVY),
        (
            "import flexgs_edge.kernels.twins, flexgs_edge.codec.open_fgs, flexgs_edge.methods.best.method\n"
            "import flexgs_edge.methods.paper.method, flexgs_edge.methods.foreign.method, flexgs_edge.commands.compress",
            ("pyopencl", "skimage", "matplotlib", "plyfile", "jinja2", "minify"),
        ),
    ],
    ids=["package", "help", "rooms without a device"],
)
def test_what_is_not_needed_is_not_imported(repository: Path, statement: str, absent: tuple[str, ...]) -> None:
    assert modules_after(statement, repository).isdisjoint(absent)


def test_help_is_quick_to_load(repository: Path) -> None:
    """`python -m flexgs_edge --help` itself, as its users start it."""
    result = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "flexgs_edge", "--help"],
        cwd=repository,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr[-2000:]
    imported = {line.rpartition("|")[2].strip().partition(".")[0] for line in result.stderr.splitlines()}
    assert imported.isdisjoint(HEAVY)
    assert "flexgs_edge" in imported and "compress" in result.stdout


def test_info_loads_nothing_heavy(repository: Path) -> None:
    """Of either version: no device, no charts, no cameras and none of what searches."""
    for version in ("v1", "v2"):
        file = repository / "tests" / "golden" / version / "tiny.fgs"
        command = f"from flexgs_edge.cli.app import main\ntry: main(['info', {str(file)!r}])\nexcept SystemExit: pass"
        script = f"import sys\n{command}\nprint(*sys.modules, file=sys.stderr)"
        result = subprocess.run(
            [sys.executable, "-c", script], cwd=repository, capture_output=True, text=True, check=False
        )
        assert result.returncode == 0 and "settings:" in result.stdout, result.stderr[-2000:]
        loaded = set(result.stderr.split())
        assert {name.partition(".")[0] for name in loaded}.isdisjoint(HEAVY)
        rooms = ("cameras", "render", "kernels", "goals", "methods", "studies", "io.exchange")
        assert loaded.isdisjoint(f"flexgs_edge.{room}" for room in rooms)


def test_modules_stay_short(repository: Path) -> None:
    lengths = {
        str(path.relative_to(repository)): len(path.read_text().splitlines())
        for folder in ("flexgs_edge", "benchmarks")
        for path in (repository / folder).rglob("*.py")
    }
    assert len(lengths) > 20
    assert {path: length for path, length in lengths.items() if length > LONGEST_MODULE} == {}
