"""How a preview is made: in stages that each leave fewer Gaussians."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexgs_edge.api.coding import compress
from flexgs_edge.codec.v2.container import GridContainer, Preview, verify_grid
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.errors import InputError
from flexgs_edge.methods.best import grid_coder, method, preview
from flexgs_edge.run.options import CompressOptions
from tiny_project import make_project


def test_each_stage_leaves_so_many_times_the_rows_that_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    project = make_project(tmp_path / "scene")
    asked: list[float] = []
    stage = preview._stage

    def counted(part: preview.Part, rows: float, *rest: Any) -> preview.Part:
        asked.append(rows)
        made = stage(part, rows, *rest)
        assert made.count <= rows + 1
        return made

    monkeypatch.setattr(preview, "_stage", counted)
    words: dict[str, Any] = {"cameras": str(project / "cameras.json"), "images": "none", "min_fidelity": 40.0}
    compress(project / "point_cloud.ply", tmp_path / "a.fgs", preview=2500, effort="fast", **words)
    stages, ends = asked[: len(preview.STAGES)], asked[len(preview.STAGES) :]
    assert 1 <= len(ends) <= preview.TRIES and sorted(ends, reverse=True) == ends
    assert stages[0] / stages[-1] == pytest.approx(preview.STAGES[0] / preview.STAGES[-1])
    # The first stages go by the bits of the whole scene's rows. The last one goes by what a file took, with its headers.
    assert stages == pytest.approx([times * ends[0] for times in preview.STAGES], rel=0.75)


def test_levels_have_a_layer_for_each_chunk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Gaussians of a layer come from its chunk: they may move, but not across the scene."""
    monkeypatch.setattr(grid_coder, "LEAST_CHUNK_ROWS", 16)
    project = make_project(tmp_path / "scene")
    words: dict[str, Any] = {"cameras": str(project / "cameras.json"), "images": "none", "min_fidelity": 40.0}
    monkeypatch.setattr(method, "LEVEL_SHARE", 0.5)
    made = compress(project / "point_cloud.ply", tmp_path / "a.fgs", levels=True, preview=2500, effort="fast", **words)
    whole = GridContainer(tmp_path / "a.fgs")
    verify_grid(tmp_path / "a.fgs")
    level = Preview(whole)
    coarse = Preview(level)
    assert made.preview_bytes == len(level.data) and len(coarse.data) <= 2500
    assert len(level.data) - len(coarse.data) <= 0.5 * whole.size
    assert coarse.header.count < level.header.count < whole.header.count
    boxes = np.array(whole.header.settings["boxes"], float)[:, :6] * whole.header.grid_steps.position
    across = np.linalg.norm(np.ptp(boxes[:, :3], axis=0))
    for container in (level, coarse):
        source = GridSource("", container)
        assert len(container.header.layers) <= whole.header.chunk_count
        for chunk in container.header.chunks():
            means = source.read(slice(chunk.start, chunk.stop), ["means"])["means"].T
            low, high = boxes[chunk.layer, :3], boxes[chunk.layer, 3:]
            away = np.maximum(np.maximum(low - means, means - high), 0)
            assert np.median(np.linalg.norm(away, axis=1)) < 0.02 * across


@pytest.mark.parametrize(
    ("words", "told"), [({"layers": 2}, "give one or the other"), ({"method": "paper"}, "--levels")]
)
def test_options_that_levels_exclude(words: dict[str, Any], told: str) -> None:
    with pytest.raises(InputError, match=told):
        CompressOptions(levels=True, **words)
