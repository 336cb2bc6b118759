"""The tiny scene that tests of several commands share."""

from __future__ import annotations

from pathlib import Path

import pytest

from flexgs_edge.commands.compress import compress
from flexgs_edge.report.results import CompressResult
from tiny_project import FAST, make_project


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_project(tmp_path_factory.mktemp("tiny") / "scene")


@pytest.fixture(scope="module")
def done(project: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, CompressResult]:
    """The tiny scene compressed against its photos, and its scores."""
    folder = tmp_path_factory.mktemp("done")
    result = compress(
        project / "point_cloud.ply", folder / "a.fgs", max_drop=2.0, save_scores=str(folder / "s.npy"), **FAST
    )
    return folder, result
