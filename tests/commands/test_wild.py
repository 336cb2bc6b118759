"""Every command on files that other programs wrote: the right result, or the right refusal; never a fault of ours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexgs_edge.commands.compress import compress
from flexgs_edge.commands.decompress import decompress
from flexgs_edge.commands.info import info
from flexgs_edge.errors import FlexGSError
from flexgs_edge.io.formats import FORMATS, WRITTEN
from flexgs_edge.run.options import ViewOptions
from flexgs_edge.run.run import open_run
from flexgs_edge.run.view_set import GivenViews
from flexgs_edge.scene.fields import FIELD
from scene_files import open_scene

PLAIN = [suffix for suffix in WRITTEN if not FORMATS[suffix].needs]
"""Formats that the plain install writes."""
READ: dict[str, tuple[int, int]] = {
    "st-minimal-v2.spz": (4, 0),
    "st-minimal-v3.spz": (4, 0),
    "st-minimal-v4.spz": (4, 0),
    "st-minimal-raw.spz": (4, 0),
    "st-minimal.splat": (4, 0),
    "st-minimal.ksplat": (4, 0),
    "ms-train3.ply": (3, 3),
    "ms-train3.spz": (3, 3),
    "ms-train3.splat": (3, 0),
    "lg-train-1000.ply": (1000, 3),
    "gf-tiny_gauss.ply": (1432, 3),
    "cvlab-pc_short.ply": (100, 3),
    "wgpu-model.ply": (9, 3),
    "bevy-khr_conformance_matrix.glb": (15, 3),
    "bevy-khr_conformance_matrix.gltf": (15, 3),
    "bevy-khr_extensible_fallback.gltf": (1, 0),
    "cesium-spz-basic.glb": (1, 0),
    "pc-guitar.compressed.ply": (90854, 0),
    "pc-logo": (307128, 0),
    "pc-logo/meta.json": (307128, 0),
    "pc-playbot": (125000, 2),
    "playbot5.sog": (3000, 2),
}
"""Gaussians and SH degree."""
REFUSED = {
    "ms-beetle.ascii.ply": "mesh",
    "lg-cube_att.ply": "mesh",
    "brush-init.ply": "point cloud",
    "lfs-pointer.ply": "Git LFS pointer",
}
SMALL = [name for name, (count, _) in READ.items() if count <= 100]
QUICK: dict[str, Any] = {"effort": "fast"}


@pytest.mark.parametrize("name", READ)
def test_what_is_read(wild: Path, name: str) -> None:
    count, degree = READ[name]
    found = info(wild / name)
    assert (found.count, found.sh_degree) == (count, degree)
    source = open_scene(wild / name)
    rows = np.unique(np.linspace(0, count - 1, min(count, 500)).astype(np.int64))
    for field, values in source.read(rows, list(FIELD)).items():
        assert np.isfinite(values).all() or field == "opacity_logits", field


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_refused_says_what_it_is(wild: Path, tmp_path: Path, name: str) -> None:
    for job in (
        lambda: info(wild / name),
        lambda: compress(wild / name, tmp_path / "a.fgs", **QUICK),
        lambda: decompress(wild / name, tmp_path / "a.spz"),
    ):
        with pytest.raises(FlexGSError, match=REFUSED[name]) as caught:
            job()
        assert name in str(caught.value) and caught.value.exit_code == 2
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", SMALL)
def test_small_files_go_to_every_format(wild: Path, tmp_path: Path, short_searches: None, name: str) -> None:
    count, degree = READ[name]
    for suffix in (".ply", *PLAIN):
        decompress(wild / name, tmp_path / f"whole{suffix}", cameras="none")
        kept = min(degree, FORMATS[suffix].max_degree) if suffix in FORMATS else degree
        back = open_scene(tmp_path / f"whole{suffix}")
        assert (back.count, back.sh_degree) == (count, kept)
    views = open_run(wild / name, ViewOptions()).seen
    given = GivenViews([camera.scaled(160, 120) for camera in views.cameras[:16]])
    turn = SMALL.index(name) % len(PLAIN)  # each format gets some of the files: all would take minutes
    for suffix in (".fgs", PLAIN[turn], PLAIN[turn - 1]):
        result = compress(wild / name, tmp_path / f"small{suffix}", given=given, near=views.near, **QUICK)
        back = open_scene(tmp_path / f"small{suffix}")
        assert 1 <= back.count == result.count <= count


def test_a_file_and_its_twin_in_another_frame(wild: Path) -> None:
    ours, theirs = (open_scene(wild / f"ms-train3.{kind}") for kind in ("ply", "spz"))
    a, b = (source.read(slice(0, 3), ["means", "sh_rest", "sh_dc"]) for source in (ours, theirs))
    np.testing.assert_allclose(a["means"], b["means"], atol=2e-3)
    np.testing.assert_allclose(a["sh_dc"], b["sh_dc"], atol=0.02)
    np.testing.assert_allclose(a["sh_rest"], b["sh_rest"], atol=0.07)
