"""Models as other programs leave them: any SH degree or none, white backgrounds, antialiased; through all of both methods."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from flexgs_edge.commands.compress import compress
from flexgs_edge.commands.decompress import ANTIALIASED_NOTE, decompress
from flexgs_edge.commands.evaluate import evaluate
from flexgs_edge.commands.info import info
from flexgs_edge.commands.render import render_views
from flexgs_edge.errors import FormatError
from flexgs_edge.io.ply import PlySource, write_ply
from flexgs_edge.run.inputs import load_scene
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource
from synthetic import random_scene
from tiny_project import write_cameras

ROWS = 80
WHITE = [1.0, 1.0, 1.0]
VIEWS: dict[str, Any] = {"holdout": 3, "resolution": 20}
COMMON: dict[str, Any] = {**VIEWS, "effort": "fast"}


def make_model(folder: Path, degree: int, zeros: bool = False) -> Path:
    """A model folder of the reference program, with `cfg_args` that says white and antialiased."""
    planes = random_scene(ROWS, 3, degree, size=-3).read(slice(0, ROWS), list(FIELD))
    if zeros:
        planes["sh_rest"][:] = 0
    inside = folder / "point_cloud" / "iteration_30000"
    inside.mkdir(parents=True)
    write_ply(inside / "point_cloud.ply", MemorySource(planes, degree))
    write_cameras(folder / "cameras.json", 4)
    (folder / "cfg_args").write_text(f"Namespace(sh_degree={degree}, white_background=True, antialiasing=True)")
    return folder


CASES = [("paper", degree, False) for degree in range(5)] + [("best", degree, False) for degree in (0, 1, 4)]
"""The slower method leaves out degrees that are between others."""


@pytest.mark.parametrize(("method", "degree", "zeros"), [*CASES, ("paper", 3, True), ("best", 3, True)])
def test_every_sh_degree_through_the_whole_pipeline(tmp_path: Path, method: str, degree: int, zeros: bool) -> None:
    """The search may drop SH where there are any; the file is drawn as the model was, wherever it lies."""
    model = make_model(tmp_path / "model", degree, zeros)
    (tmp_path / "alone").mkdir()
    file, plain = tmp_path / "alone" / "a.fgs", tmp_path / "alone" / "a.ply"
    result = compress(model, file, method=method, max_drop=3.0, **COMMON)
    assert result.reached and result.size == file.stat().st_size and result.quality is not None

    found = info(file)
    assert (found.settings["background"], found.settings["antialiased"]) == (WHITE, True)
    assert found.settings["source_sh_degree"] == degree and found.sh_degree <= degree
    assert "antialiased: True" in found.summary()
    if degree == 0 or (zeros and method == "paper"):
        assert found.sh_count == found.sh_degree == 0

    assert ANTIALIASED_NOTE in decompress(file, plain).notes
    assert (PlySource(plain).count, PlySource(plain).sh_degree) == (result.count, found.sh_degree)
    # Neither the .fgs nor its PLY has a cfg_args beside it: the one says how it is drawn, the other's original does.
    bare = tmp_path / "model" / "point_cloud" / "iteration_30000" / "point_cloud.ply"
    for judged, against in ((file, bare), (plain, model)):
        quality = evaluate(judged, against, **VIEWS).quality
        assert quality.modelled_drop == pytest.approx(result.quality.modelled_drop, abs=1e-3)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_model(tmp_path_factory.mktemp("other") / "model", 1)


def drawn(scene: Path, cameras: Path, folder: Path, **options: Any) -> np.ndarray:
    """One view, [H, W, 3] u8."""
    result = render_views(scene, folder, views=[0], cameras=str(cameras), force=True, **options)
    return np.asarray(Image.open(result.files[0])).astype(int)


def test_words_win_over_files_and_files_over_defaults(model: Path, tmp_path: Path) -> None:
    cameras, bare = model / "cameras.json", tmp_path / "bare.ply"
    shutil.copy(model / "point_cloud" / "iteration_30000" / "point_cloud.ply", bare)
    as_trained = drawn(model, cameras, tmp_path / "1")
    assert (as_trained == drawn(bare, cameras, tmp_path / "2", background=(1.0, 1.0, 1.0), antialiased=True)).all()
    default = drawn(bare, cameras, tmp_path / "3")
    assert (default == drawn(model, cameras, tmp_path / "4", background=(0.0, 0.0, 0.0), antialiased=False)).all()
    assert abs(as_trained - default).max() > 50

    fixed: dict[str, Any] = {"method": "paper", "prune_rate": 0.0, "sh_rate": 0.0, "images": "none", **COMMON}
    compress(model, tmp_path / "trained.fgs", **fixed)
    compress(model, tmp_path / "asked.fgs", antialiased=False, background=(0.0, 0.0, 0.0), **fixed)
    # What 8-bit codes may do to a view is far below what compensation and background do.
    assert abs(drawn(tmp_path / "trained.fgs", cameras, tmp_path / "5") - as_trained).mean() < 3
    assert abs(drawn(tmp_path / "asked.fgs", cameras, tmp_path / "6") - default).mean() < 3


def test_scores_are_those_of_the_way_of_drawing(model: Path, tmp_path: Path) -> None:
    """Compensated splats reach fewer pixels: none gets more hits from being thin."""
    scores = {}
    for antialiased in (None, True, False):
        path = tmp_path / f"{antialiased}.npz"
        fixed: dict[str, Any] = {"method": "paper", "prune_rate": 0.5, "sh_rate": 0.0, "images": "none", **COMMON}
        compress(model, tmp_path / f"{antialiased}.fgs", antialiased=antialiased, score_cache=str(path), **fixed)
        scores[antialiased] = np.load(path)["scores"]
    assert np.array_equal(scores[None], scores[True])
    assert (
        scores[True].sum() < scores[False].sum() or np.isneginf(scores[True]).sum() > np.isneginf(scores[False]).sum()
    )


def test_info_says_that_a_model_is_antialiased(model: Path, tmp_path: Path) -> None:
    assert "antialiased: yes" in info(model).summary()
    (tmp_path / "cfg_args").write_text("Namespace(antialiasing='yes')")
    shutil.copy(model / "point_cloud" / "iteration_30000" / "point_cloud.ply", tmp_path / "a.ply")
    assert info(tmp_path / "a.ply").antialiased is None
    (tmp_path / "cfg_args").write_text("antialiasing=True")
    with pytest.raises(FormatError, match="cfg_args"):
        info(tmp_path / "a.ply")


def test_the_3d_filter_of_mip_splatting(tmp_path: Path) -> None:
    """Scales and opacities are stored without it: read with it, by the formulas of its paper, and drawn antialiased."""
    source = random_scene(50, 8, 1, size=-3)
    write_ply(tmp_path / "plain.ply", source)
    head, data = (tmp_path / "plain.ply").read_bytes().split(b"end_header\n")
    rows = np.frombuffer(data, np.float32).reshape(50, -1)
    widths = np.random.default_rng(9).uniform(0, 0.1, (50, 1)).astype(np.float32)
    widths[7] = 0
    head += b"property float filter_3D\nend_header\n"
    (tmp_path / "mip.ply").write_bytes(head + np.hstack([rows, widths]).tobytes())

    plain = source.read(slice(0, 50), list(FIELD))
    variances = np.exp(2 * plain["log_scales"].astype(np.float64))
    wider = variances + np.square(widths[:, 0].astype(np.float64))
    opacity = 1 / (1 + np.exp(-plain["opacity_logits"].astype(np.float64))) * np.sqrt((variances / wider).prod(axis=0))
    scene = load_scene(tmp_path / "mip.ply")
    read = scene.source.read(slice(0, 50), list(FIELD))
    np.testing.assert_allclose(np.exp(2 * read["log_scales"]), wider, rtol=1e-5)
    np.testing.assert_allclose(1 / (1 + np.exp(-read["opacity_logits"])), opacity, rtol=1e-5)
    np.testing.assert_allclose(read["log_scales"][:, 7], plain["log_scales"][:, 7], rtol=1e-6)
    assert all(np.array_equal(read[name], plain[name]) for name in ("means", "quats", "sh_dc", "sh_rest"))
    assert scene.settings == {"antialiased": True} and "filter_3D applied" in scene.source.notes[0]
    assert "antialiased: yes" in info(tmp_path / "mip.ply").summary()
    picked = scene.source.select(np.array([3, 40])).read(slice(0, 2), ["opacity_logits"])["opacity_logits"]
    assert np.array_equal(picked, read["opacity_logits"][:, [3, 40]])
