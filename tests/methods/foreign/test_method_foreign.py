"""`compress` and `decompress` to other programs' formats, end to end: targets hold on the files as they decode."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexgs_edge.cli import app
from flexgs_edge.commands.compress import compress
from flexgs_edge.commands.decompress import decompress
from flexgs_edge.commands.evaluate import evaluate
from flexgs_edge.commands.info import info
from flexgs_edge.errors import BudgetError, InputError, TargetError
from flexgs_edge.io.exchange import read_foreign
from flexgs_edge.io.frames import RDF
from flexgs_edge.io.ply import write_ply
from flexgs_edge.io.reading import Reading
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.report.results import CompressResult
from flexgs_edge.scene.fields import FIELD
from scene_files import open_scene
from stopped import Stopped
from synthetic import random_scene
from tiny_project import COUNT, make_project

FAST: dict[str, Any] = {"effort": "fast", "holdout": 4}
PAPER: dict[str, Any] = {"method": "paper", **FAST}
"""The quicker search, where a test is not about the method."""
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_project(tmp_path_factory.mktemp("tiny") / "scene", degree=2)


@pytest.fixture(scope="module", params=[".spz", ".compressed.ply", ".sog", ".glb"])
def done(
    request: pytest.FixtureRequest, project: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, CompressResult]:
    """The tiny scene in a format, at a drop of at most 2 dB."""
    path = tmp_path_factory.mktemp("done") / f"a{request.param}"
    return path, compress(project / "point_cloud.ply", path, max_drop=2.0, **FAST)


def test_the_target_holds_on_the_file(project: Path, done: tuple[Path, CompressResult]) -> None:
    path, result = done
    assert result.reached and result.decided_by == "drop"
    assert result.size == path.stat().st_size and [p.name for p in path.parent.iterdir()] == [path.name]
    found = evaluate(path, project / "point_cloud.ply", holdout=4)
    assert result.quality is not None and found.quality.views == result.quality.views
    assert found.quality.drop is not None and found.quality.drop <= 2.0
    assert result.search is not None and result.search.chosen.measurement is not None
    assert found.quality.drop == result.search.chosen.measurement.drop
    source = open_scene(path)
    assert (source.count, source.sh_degree) == (result.count, result.file_sh_degree) and source.count <= COUNT
    assert min(step.size for step in result.search.steps if step.holds) == result.size


def test_the_record_says_what_was_written(done: tuple[Path, CompressResult]) -> None:
    path, result = done
    record = json.loads(json.dumps(result.to_json(), allow_nan=False))
    assert record["format"] == path.name[2:] and record["bits"] == {} and record["steps"] is None
    assert record["search"] and all(step["phase"] == "multiplier" for step in record["search"])
    text = result.summary()
    assert f"{result.size} bytes" in text and f".{record['format']}, SH degree {result.file_sh_degree}" in text
    assert info(path).format == record["format"] and info(path).count == result.count


def test_same_command_same_bytes(project: Path, done: tuple[Path, CompressResult], tmp_path: Path) -> None:
    path, result = done
    again = tmp_path / path.name
    limit = MemoryBudget.from_limit(None).used + 250 * 2**20
    compress(project / "point_cloud.ply", again, max_drop=2.0, memory_limit=limit, **FAST)
    data = again.read_bytes()
    assert data == path.read_bytes()
    if path.suffix == ".spz":
        assert data[:10] == bytes([31, 139, 8, 0, 0, 0, 0, 0, 2, 255]), "a name or a time in the gzip header"


@pytest.mark.parametrize("suffix", [".spz", ".compressed.ply"])
def test_finished_files_fit(project: Path, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    limit = 6000 if suffix == ".spz" else 7500
    result = compress(project / "point_cloud.ply", path, max_size=limit, **FAST)
    assert result.reached and 0.7 * limit < path.stat().st_size <= limit and result.size == path.stat().st_size


def test_out_of_reach(project: Path, tmp_path: Path) -> None:
    words = {**FAST, "min_fidelity": 150.0}
    with pytest.raises(TargetError, match=r"fidelity >= 150 dB .*the closest point.*--best-effort"):
        compress(project / "point_cloud.ply", tmp_path / "a.spz", **words)
    assert list(tmp_path.iterdir()) == []
    closest = compress(project / "point_cloud.ply", tmp_path / "a.spz", best_effort=True, **words)
    assert closest.reached is False and closest.count > 0.9 * COUNT and "NOT reached" in closest.summary()


def test_a_format_without_sh(project: Path, tmp_path: Path) -> None:
    """The original's SH stay in the references, and the search knows that the file has none."""
    words = {**FAST, "method": "best", "best_effort": True, "max_drop": 0.5}
    result = compress(project / "point_cloud.ply", tmp_path / "a.splat", **words)
    source = open_scene(tmp_path / "a.splat")
    assert (source.count, source.sh_degree) == (result.count, 0) == (result.count, result.file_sh_degree)
    assert result.size == 32 * result.count and result.sh_count == 0 and result.scene.sh_degree == 2


def test_a_spz_inside_a_glb(project: Path, tmp_path: Path) -> None:
    words = {**FAST, "max_drop": 2.0}
    result = compress(project / "point_cloud.ply", tmp_path / "a.glb", glb="spz", **words)
    spz = compress(project / "point_cloud.ply", tmp_path / "a.spz", **words)
    assert result.reached and result.count == spz.count and 0 < result.size - spz.size < 4000
    with pytest.raises(InputError, match="--glb draco: expected plain or spz"):
        compress(project / "point_cloud.ply", tmp_path / "b.glb", glb="draco", **words)


def test_without_writing(project: Path, tmp_path: Path, own_temporary_folder: Path) -> None:
    dry = compress(project / "point_cloud.ply", tmp_path / "a.spz", dry_run=True, max_drop=2.0, **FAST)
    assert dry.output is None and dry.format == "spz" and [p.name for p in tmp_path.iterdir()] == ["tmp"]
    real = compress(project / "point_cloud.ply", tmp_path / "a.spz", max_drop=2.0, **FAST)
    assert real.size == dry.size == (tmp_path / "a.spz").stat().st_size and real.quality == dry.quality
    assert list(own_temporary_folder.iterdir()) == []


def test_the_refit_pays(project: Path, tmp_path: Path) -> None:
    words = {**FAST, "method": "best", "images": "none", "max_size": 6000}
    drops = []
    for refit in (True, False):
        result = compress(project / "point_cloud.ply", tmp_path / f"{refit}.spz", refit=refit, **words)
        assert result.quality is not None
        drops.append(result.quality.modelled_drop)
    assert drops[0] < drops[1]


def test_files_of_these_formats_go_in_again(project: Path, tmp_path: Path) -> None:
    scene = project / "point_cloud.ply"
    decompress(scene, tmp_path / "a.spz")
    result = compress(tmp_path / "a.spz", tmp_path / "b.fgs", cameras=str(project), min_fidelity=20.0, **PAPER)
    assert result.scene.count == COUNT and result.format == "fgs"
    for name in ("c.compressed.ply", "d.sog", "e.ply"):
        assert decompress(tmp_path / "b.fgs", tmp_path / name).size == (tmp_path / name).stat().st_size
        assert open_scene(tmp_path / name).count == result.count


@pytest.mark.parametrize(
    ("name", "words", "message"),
    [
        ("a.spz", {"method": "paper"}, r"--method paper writes \.fgs files alone, not \.spz"),
        ("a.xyz", {}, r"expected a name that ends in \.fgs, \.spz, \.sog, \.compressed\.ply, \.splat, \.glb"),
        ("a.ksplat", {}, r"\.ksplat files are only read"),
        ("none/a.spz", {}, "does not exist"),
        ("a.spz", {"memory_limit": 2**20}, r"--memory-limit \d+MiB or more"),
    ],
)
def test_what_is_refused(project: Path, tmp_path: Path, name: str, words: dict[str, Any], message: str) -> None:
    with pytest.raises((InputError, BudgetError), match=message):
        compress(project / "point_cloud.ply", tmp_path / name, **FAST, **words)
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_left_behind(project: Path, tmp_path: Path) -> None:
    (tmp_path / "a.spz").write_text("earlier")
    with pytest.raises(InputError, match="the file exists"):
        compress(project / "point_cloud.ply", tmp_path / "a.spz", **FAST)

    words = {"force": True, "progress": Stopped(enabled=False), "promise": "mean", **FAST}
    with pytest.raises(KeyboardInterrupt):
        compress(project / "point_cloud.ply", tmp_path / "a.spz", **words)
    assert [path.name for path in tmp_path.iterdir()] == ["a.spz"] and (tmp_path / "a.spz").read_text() == "earlier"


def test_on_the_command_line(
    project: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = str(project / "point_cloud.ply")
    command = ["compress", scene, "-o", str(tmp_path / "a.spz"), "--min-fidelity", "150", "--effort", "fast"]
    with pytest.raises(SystemExit) as caught:
        app.main([*command, "-q", "--holdout", "4"])
    assert caught.value.code == 3 and "the closest point has fidelity" in capsys.readouterr().err
    with pytest.raises(SystemExit) as caught:
        app.main(["decompress", scene, "-o", str(tmp_path / "a.compressed.ply"), "-q"])
    assert caught.value.code == 0 and "a.compressed.ply" in capsys.readouterr().out
    with pytest.raises(SystemExit) as caught:
        app.main(["info", str(tmp_path / "a.compressed.ply")])
    assert caught.value.code == 0 and f"{COUNT}, SH degree 2" in capsys.readouterr().out


def test_gsply_sees_what_we_see(done: tuple[Path, CompressResult]) -> None:
    gsply = pytest.importorskip("gsply")
    path, result = done
    if path.suffix == ".glb":
        pytest.skip("gsply does not read .glb")
    if path.suffix == ".sog":
        pytest.importorskip("imagecodecs", reason="gsply reads .sog through imagecodecs")
        found = gsply.sogread(str(path))
    else:
        found = gsply.read_spz(str(path)) if path.suffix == ".spz" else gsply.plyread(str(path))
    source = read_foreign(path, Reading(frame=RDF))  # as the values stand in the file
    ours = source.read(slice(0, source.count), list(FIELD))
    theirs = {"means": found.means, "log_scales": found.scales, "sh_dc": found.sh0}
    if source.sh_degree:
        theirs["sh_rest"] = np.asarray(found.shN).transpose(0, 2, 1).reshape(source.count, -1)
    for name, values in theirs.items():
        np.testing.assert_allclose(np.asarray(values).T, ours[name], atol=1e-5, err_msg=name)


def test_a_format_too_coarse_for_the_default_target_still_gives_a_file(tmp_path: Path) -> None:
    """Who names no target wants a file; who names one is told that it cannot be met."""
    source = random_scene(40, seed=4, degree=0)
    write_ply(tmp_path / "scene.ply", source)
    words: dict[str, Any] = {"method": "best", "effort": "fast", "base_psnr": 90.0, "resolution": 64}
    result = compress(tmp_path / "scene.ply", tmp_path / "a.spz", **words)
    assert result.reached is False and result.count >= 1 and open_scene(tmp_path / "a.spz").count == result.count
    assert any(".spz, which rounds too coarsely" in warning for warning in result.warnings)
    with pytest.raises(TargetError):
        compress(tmp_path / "scene.ply", tmp_path / "b.spz", max_drop=1.0, **words)
