"""How a preview is made: in stages that each leave fewer Gaussians."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from flexgs_edge.api.coding import compress
from flexgs_edge.methods.best import preview
from flexgs_edge.methods.best.grid_coder import projected_size, with_preview
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.scene.source import Planes
from tiny_project import make_project


def test_each_stage_leaves_so_many_times_the_rows_that_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    project = make_project(tmp_path / "scene")
    asked: list[float] = []
    stage = preview._stage

    def counted(planes: Planes, rows: float, *rest: Any) -> Planes:
        asked.append(rows)
        made = stage(planes, rows, *rest)
        assert made["means"].shape[1] <= rows + 1
        return made

    monkeypatch.setattr(preview, "_stage", counted)
    words: dict[str, Any] = {"cameras": str(project / "cameras.json"), "images": "none", "min_fidelity": 40.0}
    compress(project / "point_cloud.ply", tmp_path / "a.fgs", preview=2500, effort="fast", **words)
    stages, ends = asked[: len(preview.STAGES)], asked[len(preview.STAGES) :]
    assert 1 <= len(ends) <= preview.TRIES and sorted(ends, reverse=True) == ends
    assert stages[0] / stages[-1] == pytest.approx(preview.STAGES[0] / preview.STAGES[-1])
    # The first stages go by the bits of the whole scene's rows. The last one goes by what a file took, with its headers.
    assert stages == pytest.approx([times * ends[0] for times in preview.STAGES], rel=0.75)


@pytest.mark.parametrize(
    ("asked", "size", "room"), [(None, 999_999, 0), (None, 2_000_000, 40_000), (0, 2_000_000, 0), (5000, 100, 5000)]
)
def test_a_size_leaves_room_for_the_preview(asked: int | None, size: int, room: int) -> None:
    assert projected_size(CompressOptions(preview=asked), size) == size + with_preview(room)
