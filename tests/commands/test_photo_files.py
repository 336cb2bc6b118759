"""Photos of another exposure, or of something else, let no file lose more than even ones would."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from flexgs_edge.commands.compress import compress
from flexgs_edge.commands.evaluate import evaluate
from flexgs_edge.report.results import CompressResult
from tiny_project import FAST, make_project


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_project(tmp_path_factory.mktemp("photos") / "scene")


def compressed(project: Path, images: Path, output: Path, **words: Any) -> tuple[CompressResult, float]:
    """A result with the photos of a folder, and its drop against the project's own."""
    result = compress(project / "point_cloud.ply", output, max_drop=2.0, images=str(images), **FAST, **words)
    even = evaluate(output, project / "point_cloud.ply", holdout=FAST["holdout"]).quality
    assert even is not None and even.drop is not None
    return result, even.drop


def test_photos_of_other_exposures_are_fitted_once_and_said(project: Path, tmp_path: Path) -> None:
    folder, rng = tmp_path / "exposed", np.random.default_rng(4)
    folder.mkdir()
    for path in sorted((project / "images").iterdir()):
        stops = rng.uniform(-1.0, 0.7) + rng.normal(0.0, 0.1, 3) - 0.5
        values = np.asarray(Image.open(path)) / 255.0 * 2.0 ** (stops / 2.2)
        Image.fromarray((values.clip(0, 1) * 255).round().astype(np.uint8)).save(folder / path.name)
    _, expected = compressed(project, project / "images", tmp_path / "even.fgs")
    result, found = compressed(project, folder, tmp_path / "exposed.fgs")
    assert found == pytest.approx(expected, abs=0.1)
    quality = result.quality
    assert quality is not None and any(view.exposure for view in quality.views)
    assert "brought to the exposure of the original" in result.summary() and "--exposure none" in result.summary()
    record = result.to_json()["quality"]["views"]
    assert [len(view["exposure"]) for view in record if view["exposure"]]
    plain, _ = compressed(project, folder, tmp_path / "plain.fgs", exposure="none")
    assert plain.quality is not None and not any(view.exposure for view in plain.quality.views)
    assert "exposure:" not in plain.summary()


def test_photos_of_something_else_count_as_none(project: Path, tmp_path: Path) -> None:
    """A picture that never matched loses nothing by becoming grey."""
    folder, paths = tmp_path / "shifted", sorted((project / "images").iterdir())
    folder.mkdir()
    for place, path in enumerate(paths):
        image = np.asarray(Image.open(path))[::-1, ::-1]
        Image.fromarray(np.ascontiguousarray(image)).save(folder / paths[(place + 4) % len(paths)].name)
    result, _ = compressed(project, folder, tmp_path / "shifted.fgs", trust_views=True)
    quality = result.quality
    assert quality is not None and all(view.far_base == quality.base_psnr for view in quality.views)
    assert quality.usual_drop is not None and 0.0 < quality.usual_drop <= 2.0
    words = {"max_drop": 2.0, "images": "none", "base_psnr": quality.base_psnr, **FAST}
    alone = compress(project / "point_cloud.ply", tmp_path / "alone.fgs", **words)
    assert result.count >= 0.7 * alone.count and "far from its photo" in result.summary()
