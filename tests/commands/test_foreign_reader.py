"""A decoded PLY in a reader that nobody here wrote: every viewer should see the scene that our own decoder sees."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from flexgs_edge.codec.open_fgs import open_fgs
from flexgs_edge.commands.compress import compress
from flexgs_edge.commands.decompress import decompress
from flexgs_edge.scene.fields import FIELD


@pytest.fixture(scope="module", params=[(0.2, 0.4), (0.0, 0.0)], ids=["pruned", "whole"])
def files(
    request: pytest.FixtureRequest, sample_dir: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Path]:
    """A `.fgs` of the sample and the PLY that it decodes to."""
    folder = tmp_path_factory.mktemp("decoded")
    prune, sh = request.param
    words = {"method": "paper", "prune_rate": prune, "sh_rate": sh, "images": "none"}
    compress(sample_dir / "point_cloud.ply", folder / "a.fgs", resolution=64, **words)
    decompress(folder / "a.fgs", folder / "a.ply")
    return folder / "a.fgs", folder / "a.ply"


def test_gsply_reads_equal_values(files: tuple[Path, Path]) -> None:
    gsply = pytest.importorskip("gsply")
    container, ply = files
    source = open_fgs(container)
    ours = source.read(slice(0, source.count), list(FIELD))
    theirs = gsply.plyread(str(ply))
    for name, values in {
        "means": theirs.means,
        "log_scales": theirs.scales,
        "quats": theirs.quats,
        "opacity_logits": theirs.opacities.reshape(-1, 1),
        "sh_dc": theirs.sh0,
        "sh_rest": theirs.shN.transpose(0, 2, 1).reshape(source.count, -1),
    }.items():
        np.testing.assert_array_equal(np.asarray(values).T, ours[name], err_msg=name)


def test_plyfile_reads_equal_values(files: tuple[Path, Path]) -> None:
    container, ply = files
    source = open_fgs(container)
    ours = source.read(slice(0, source.count), list(FIELD))
    vertex = PlyData.read(str(ply))["vertex"]
    assert vertex.count == source.count
    for name, field in FIELD.items():
        for channel, column in enumerate(field.ply_names(source.sh_degree)):
            np.testing.assert_array_equal(vertex[column], ours[name][channel], err_msg=column)
