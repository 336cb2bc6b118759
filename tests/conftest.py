"""Fixtures that tests share: where the scenes are, and views that take little room."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Generator, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fits import use_fit
from flexgs_edge.methods.best.effort import EFFORTS

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def repository() -> Path:
    """The checkout."""
    return REPOSITORY


@pytest.fixture(scope="session")
def sample_dir() -> Path:
    """The bundled scene: `point_cloud.ply`, `cameras.json`, `images/`."""
    folder = REPOSITORY / "samples" / "still_life"
    assert (folder / "point_cloud.ply").is_file(), f"the sample scene is part of the repository, but {folder} lacks it"
    return folder


@pytest.fixture(scope="session")
def scenes_dir() -> Path:
    """Larger scenes outside the repository: FLEXGS_SCENES, by default `../shared/scenes`."""
    folder = Path(os.environ.get("FLEXGS_SCENES", REPOSITORY.parent / "shared" / "scenes"))
    if not folder.is_dir():
        pytest.skip(f"no scenes at {folder}: set FLEXGS_SCENES to a folder that has them")
    return folder


@pytest.fixture(scope="session")
def fox_dir(scenes_dir: Path) -> Path:
    """The fox scene with its golden renders."""
    folder = scenes_dir / "fox"
    if not (folder / "point_cloud.ply").is_file():
        pytest.skip(f"no fox scene at {folder}: set FLEXGS_SCENES to a folder that has it")
    return folder


@pytest.fixture(scope="session")
def wild() -> Path:
    """Files that other programs wrote, outside the repository: FLEXGS_WILD, by default `../shared/wild`."""
    folder = Path(os.environ.get("FLEXGS_WILD", REPOSITORY.parent / "shared" / "wild"))
    if not folder.is_dir():
        pytest.skip(f"no files of other programs at {folder}: set FLEXGS_WILD to a folder that has them")
    return folder


@pytest.fixture(scope="session")
def node_modules() -> Path:
    """Programs of the npm registry that read splat files: FLEXGS_NODE_MODULES, by default `.node/node_modules`."""
    folder = Path(os.environ.get("FLEXGS_NODE_MODULES", REPOSITORY / ".node" / "node_modules"))
    if not folder.is_dir() or shutil.which("node") is None:
        pytest.skip(f"no node, or no packages at {folder}: deploy/test.sh installs them where npm is there")
    return folder


@pytest.fixture
def compact(monkeypatch: pytest.MonkeyPatch) -> None:
    """Views hold what they show, with room for few rows at first, in chunks of 64 rows."""
    use_fit(monkeypatch, whole_views=False, capacity_step=32, first_share=100, compact_rows=64, spare_share=1)


@pytest.fixture(scope="module")
def short_searches() -> Iterator[None]:
    """The first whole result that holds is the answer: on tiny scenes one takes a second, nearly all of it the coder's tables."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("fast", "max"):
            patch.setitem(EFFORTS, name, replace(EFFORTS[name], close=1.0))
        yield


@pytest.fixture
def own_temporary_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where temporary files are made: `tmp` in the test's folder, so that it can look for what is left."""
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    return tmp_path / "tmp"


@pytest.hookimpl(wrapper=True)
def pytest_report_to_serializable() -> Generator[None, Any, Any]:
    """Reports travel between test processes as UTF-8, which has no place for the odd bytes of paths that some tests make."""
    return _printable((yield))


def _printable(value: Any) -> Any:
    if isinstance(value, str):
        return value.encode("utf-8", "backslashreplace").decode()
    if isinstance(value, dict):
        return {_printable(key): _printable(inner) for key, inner in value.items()}
    return type(value)(map(_printable, value)) if isinstance(value, (list, tuple)) else value
