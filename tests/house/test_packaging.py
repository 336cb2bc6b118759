"""What is shipped: the file lists of wheel and sdist, and an installed copy that finds its kernels."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
from setuptools import find_packages
from setuptools.config.setupcfg import read_configuration

import flexgs_edge


@pytest.fixture(scope="module")
def archives(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """(sdist, wheel built from that sdist)."""
    # Built from a copy: setuptools leaves build/ and *.egg-info where it works, and a stale one can hide a missing file.
    tree, out = tmp_path_factory.mktemp("tree"), tmp_path_factory.mktemp("dist")
    for name in (
        "setup.cfg",
        "pyproject.toml",
        "MANIFEST.in",
        "LICENSE",
        "README.md",
        "CHANGELOG.md",
        "constraints.txt",
    ):
        (tree / name).write_bytes((repository / name).read_bytes())
    for name in ("flexgs_edge", "cl_kernels", "web", "docs", "tests", "samples", "benchmarks", "deploy"):
        (tree / name).symlink_to(repository / name)
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out), str(tree)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    return next(out.glob("*.tar.gz")), next(out.glob("*.whl"))


def files_of(archive: Path) -> set[str]:
    if archive.suffix == ".whl":
        return {name for name in zipfile.ZipFile(archive).namelist() if not name.endswith("/")}
    with tarfile.open(archive) as tar:  # without the leading folder
        return {name.partition("/")[2] for name in (member.name for member in tar if member.isfile())}


def kernel_files(repository: Path) -> set[str]:
    return {path.name for path in (repository / "cl_kernels").iterdir() if path.suffix in (".cl", ".clh")}


def python_files(repository: Path) -> set[str]:
    """Modules, the stub of the face, the mark that says that types are shipped, and what the self-test plays."""
    modules = {str(path.relative_to(repository)) for path in (repository / "flexgs_edge").rglob("*.py")}
    return modules | {"flexgs_edge/__init__.pyi", "flexgs_edge/py.typed", "flexgs_edge/kernels/self_test.bin"}


def template_files(repository: Path) -> set[str]:
    folder = repository / "flexgs_edge" / "report" / "templates"
    return {str(path.relative_to(repository)) for path in folder.iterdir()}


def web_file_names(repository: Path) -> set[str]:
    """What the viewer and its decoder need to run."""
    web = repository / "web"
    places = [
        *(web / "decoder" / "src").glob("*.js"),
        *(web / "viewer" / "src").glob("*.js"),
        *(web / "viewer").glob("*.html"),
    ]
    return {str(place.relative_to(repository)) for place in [*places, *(web / "viewer").glob("*.css")]}


def test_every_package_is_listed_in_setup_cfg(repository: Path) -> None:
    listed = set(read_configuration(repository / "setup.cfg")["options"]["packages"])
    found = {*find_packages(str(repository), include=["flexgs_edge*"]), "flexgs_edge.cl_kernels", "flexgs_edge.web"}
    assert listed == found, "correct [options] packages in setup.cfg"


def test_the_wheel_holds_the_package_the_templates_and_the_kernels(
    repository: Path, archives: tuple[Path, Path]
) -> None:
    files = {name for name in files_of(archives[1]) if ".dist-info/" not in name}
    kernels = {f"flexgs_edge/cl_kernels/{name}" for name in kernel_files(repository)}
    web = {f"flexgs_edge/{name}" for name in web_file_names(repository)}
    assert files == python_files(repository) | template_files(repository) | kernels | web


def test_the_sdist_can_be_built_from_and_holds_no_tests(repository: Path, archives: tuple[Path, Path]) -> None:
    files = files_of(archives[0])
    assert python_files(repository) | template_files(repository) <= files
    assert {f"cl_kernels/{name}" for name in kernel_files(repository)} <= files
    assert web_file_names(repository) <= files
    assert {"LICENSE", "README.md", "CHANGELOG.md", "constraints.txt", "setup.cfg", "pyproject.toml"} <= files
    assert {"docs/design.md", "docs/format.md"} <= files
    assert [name for name in files if name.startswith(("tests/", "samples/", "benchmarks/", "deploy/"))] == []


def test_name_version_licence_and_command(archives: tuple[Path, Path]) -> None:
    wheel = zipfile.ZipFile(archives[1])
    info = f"flexgs_edge-{flexgs_edge.__version__}.dist-info"
    metadata = wheel.read(f"{info}/METADATA").decode()
    assert f"\nName: flexgs-edge\nVersion: {flexgs_edge.__version__}\n" in metadata
    assert "Requires-Python: >=3.10" in metadata
    assert re.search(r"^License(-Expression)?: Apache-2\.0$", metadata, re.MULTILINE)
    assert "flexgs-edge = flexgs_edge.cli.app:main" in wheel.read(f"{info}/entry_points.txt").decode()
    assert any(name.endswith("LICENSE") for name in wheel.namelist())


def test_an_installed_copy_has_its_viewer(archives: tuple[Path, Path], tmp_path: Path) -> None:
    zipfile.ZipFile(archives[1]).extractall(tmp_path)
    script = f"""
import sys
sys.path.insert(0, {str(tmp_path)!r})
from flexgs_edge.viewer.assets import PAGE, web_files, web_folder
print(web_folder())
print(PAGE in web_files())
"""
    assert run_in(tmp_path, script) == [str(tmp_path / "flexgs_edge" / "web"), "True"]


def run_in(folder: Path, script: str, **environment: str) -> list[str]:
    """Output lines of `script` in an interpreter outside the checkout."""
    variables = {name: value for name, value in os.environ.items() if not name.startswith(("FLEXGS", "PYTHONPATH"))}
    result = subprocess.run(
        [sys.executable, "-c", script],
        cwd=folder,
        env={**variables, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    return result.stdout.splitlines()


FIND_KERNELS = """
import flexgs_edge
from flexgs_edge.kernels.cl_sources import kernel_dir, load_source
print(flexgs_edge.__file__)
print(kernel_dir())
for path in sorted(kernel_dir().glob("*.cl")):
    load_source(path.name)
    print(path.name)
"""


FIND_TEMPLATES = """
from flexgs_edge.report.html import environment
print(*environment().list_templates(), sep="\\n")
"""


def test_an_installed_wheel_finds_its_kernels_and_templates(
    repository: Path, archives: tuple[Path, Path], tmp_path: Path
) -> None:
    target = tmp_path / "site"
    command = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-index", "--no-compile"]
    subprocess.run([*command, "--target", str(target), str(archives[1])], check=True, capture_output=True)
    package, kernels, *files = run_in(tmp_path, FIND_KERNELS, PYTHONPATH=str(target))
    assert Path(package) == target / "flexgs_edge" / "__init__.py"
    assert Path(kernels) == target / "flexgs_edge" / "cl_kernels"
    assert set(files) == {name for name in kernel_files(repository) if name.endswith(".cl")}
    found = run_in(tmp_path, FIND_TEMPLATES, PYTHONPATH=str(target))
    assert found == sorted(Path(name).name for name in template_files(repository))


USERS_SCRIPT = """
import numpy as np
from numpy.typing import NDArray

import flexgs_edge

cameras = flexgs_edge.Cameras.open("cameras.json")
photos: list[NDArray[np.uint8]] = [np.zeros((camera.height, camera.width, 3), np.uint8) for camera in cameras]
scene = flexgs_edge.Scene.from_arrays(**flexgs_edge.Scene.open("point_cloud.ply").arrays())
data, result = flexgs_edge.encode(scene, cameras=cameras, images=photos, max_drop=0.5, effort="fast")
size: int = result.size if result.reached else 0
image: NDArray[np.float32] = flexgs_edge.decode(data).render(cameras[0], background=(1.0, 1.0, 1.0))
layers: list[int] = [layer.bytes for layer in flexgs_edge.open("scene.fgs").layers]
"""
WRONG_SCRIPT = """
import flexgs_edge

flexgs_edge.compress("point_cloud.ply", "scene.fgs", max_dorp=0.5)
flexgs_edge.Scene.open("point_cloud.ply").cuont
"""


@pytest.mark.parametrize("checker", ["mypy", "pyright"])
def test_a_users_script_type_checks(checker: str, archives: tuple[Path, Path], tmp_path: Path) -> None:
    """Against the installed wheel: the stub, its types and its mark are there."""
    pytest.importorskip(checker, reason=f"{checker} is not installed")
    if checker == "pyright" and shutil.which("node") is None:
        pytest.skip("pyright needs Node.js")
    site, empty = tmp_path / "site", tmp_path / "empty"
    zipfile.ZipFile(archives[1]).extractall(site)
    empty.mkdir()
    (tmp_path / "right.py").write_text(USERS_SCRIPT)
    (tmp_path / "wrong.py").write_text(WRONG_SCRIPT)
    (tmp_path / "pyrightconfig.json").write_text(json.dumps({"extraPaths": [str(site)]}))
    arguments = ["--strict", "--cache-dir", str(empty)] if checker == "mypy" else ["--pythonpath", sys.executable]
    variables = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}

    def check(script: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", checker, *arguments, script],
            cwd=tmp_path,
            env={**variables, "PYTHONPATH": str(site)},
            capture_output=True,
            text=True,
            check=False,
        )

    found = check("right.py")
    if checker == "pyright" and "npm" in found.stderr:
        pytest.skip("pyright could not be fetched")
    assert found.returncode == 0, found.stdout + found.stderr
    found = check("wrong.py")
    assert found.returncode == 1 and "max_dorp" in found.stdout and "cuont" in found.stdout, found.stdout + found.stderr


def test_an_editable_install_finds_the_kernels_of_the_checkout(repository: Path, tmp_path: Path) -> None:
    # setuptools' own hook makes the editable wheel; installing it is unzipping it into a folder of site-packages.
    tree, site = tmp_path / "tree", tmp_path / "site"
    tree.mkdir()
    for name in ("setup.cfg", "pyproject.toml", "LICENSE", "README.md", "flexgs_edge", "cl_kernels", "web"):
        (tree / name).symlink_to(repository / name)
    build = f"import setuptools.build_meta as b; print(b.build_editable({str(tmp_path)!r}))"
    wheel = run_in(tree, build)[-1]
    zipfile.ZipFile(tmp_path / wheel).extractall(site)
    script = f"import site; site.addsitedir({str(site)!r})\n{FIND_KERNELS}"
    package, kernels, *files = run_in(tmp_path, script)
    assert Path(package).resolve() == repository / "flexgs_edge" / "__init__.py"
    assert Path(kernels) == repository / "cl_kernels"
    assert files
