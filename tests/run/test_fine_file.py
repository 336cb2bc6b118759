"""Large scenes that were never compressed, for the viewer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flexgs_edge.codec.open_fgs import open_fgs
from flexgs_edge.codec.v2.container import BOXES, GridContainer, write_grid
from flexgs_edge.commands.evaluate import evaluate
from flexgs_edge.grid.step_sizes import holdable
from flexgs_edge.grid.to_grid import to_grid
from flexgs_edge.io.ply import write_ply
from flexgs_edge.memory.storage import IN_MEMORY
from flexgs_edge.progress import SILENT
from flexgs_edge.run import fine_file
from flexgs_edge.run.fine_file import LEAST_FINE, NEIGHBOURS, fine_steps, heaviest, write_fine
from flexgs_edge.run.options import NO_CAMERAS, ViewOptions
from flexgs_edge.run.run import Run, open_run
from flexgs_edge.scene.source import MemorySource, growth, read_all
from synthetic import random_scene


def planned(scene: Path, **words: object) -> Run[ViewOptions]:
    """A run that only looks."""
    return open_run(scene, ViewOptions(cameras=NO_CAMERAS, **words), SILENT, photos=False, decodes=False)  # type: ignore[arg-type]


def test_its_steps_show_a_scene_as_it_is(sample_dir: Path, tmp_path: Path) -> None:
    scene, path = sample_dir / "point_cloud.ply", tmp_path / "fine.fgs"
    source = planned(scene).source
    planes = read_all(source, IN_MEMORY)
    steps = holdable(fine_steps(planes, source.sh_degree), planes)
    write_grid(path, to_grid(planes, np.full(source.count, source.sh_degree), steps, source.origin)[0], {})
    found = evaluate(path, scene, cameras=str(sample_dir / "cameras.json"), holdout=16)
    assert found.quality.fidelity >= 50


def test_a_large_scene_has_boxes_and_a_preview(tmp_path: Path) -> None:
    planes = read_all(random_scene(4096, 0, 1), IN_MEMORY)
    many = {name: np.tile(values, LEAST_FINE // 4096) for name, values in planes.items()}
    many["means"] = many["means"] + np.repeat(np.arange(LEAST_FINE // 4096), 4096).astype(np.float32)
    scene, path = tmp_path / "large.ply", tmp_path / "fine.fgs"
    write_ply(scene, MemorySource(many))
    assert write_fine(path, planned(scene), {"start": "kept"})
    container = GridContainer(path)
    assert container.header.settings["start"] == "kept" and len(container.header.settings[BOXES]) == 8
    assert open_fgs(path).count == LEAST_FINE
    preview = tmp_path / "preview.fgs"
    preview.write_bytes(container.read_preview())
    assert open_fgs(preview).count == LEAST_FINE // NEIGHBOURS
    assert not write_fine(path, planned(scene, device="numpy"), {})
    assert not write_fine(path, planned(scene, memory_limit=300 << 20), {})


def test_of_what_memory_does_not_hold_a_part_is_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(fine_file, "LEAST_FINE", 1)
    scene, path = tmp_path / "scene.ply", tmp_path / "fine.fgs"
    write_ply(scene, random_scene(90_000, 0, 0))
    run = planned(scene)
    run.budget.limit = run.budget.used + (200 << 20)
    monkeypatch.setattr(fine_file, "VALUE_BYTES", 4 * (200 << 20) // 14 // 90_000)
    assert write_fine(path, run, {})
    assert 15_000 < open_fgs(path).count <= 22_500
    assert "of 90000 Gaussians are shown" in caplog.text


def test_the_preview_has_what_holds_back_most_light() -> None:
    planes = read_all(random_scene(7, 0, 1), IN_MEMORY)
    planes["log_scales"][:] = [[-5, -5, -2, -3, -4, -4, 9], [-5, -1, -2, -3, -4, -4, 9], [-5, -9, -2, -3, -4, -4, 9]]
    planes["opacity_logits"][:] = [[9, 9, -9, 1, 9, 9, 9]]
    few = heaviest(planes, np.array([4, 0, 2, 5, 1, 3, 6]), 3)
    rows = [1, 4]  # -6 of -8, -6 and -6.3; -8 of -8, -10 and -13
    np.testing.assert_array_equal(few["means"], planes["means"][:, rows])
    np.testing.assert_array_equal(few["log_scales"], planes["log_scales"][:, rows] + growth(2, 7))
    assert few["sh_rest"].shape == (0, 2)


def test_a_small_scene_is_left_to_version_1(sample_dir: Path, tmp_path: Path) -> None:
    assert not write_fine(tmp_path / "fine.fgs", planned(sample_dir / "point_cloud.ply"), {})
    assert list(tmp_path.iterdir()) == []
