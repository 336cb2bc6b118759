"""`compress` and `decompress` to other programs' formats, end to end: targets hold on the files as they decode."""

from __future__ import annotations

import gzip
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
from flexgs_edge.io.exchange import near_order, read_foreign, write_foreign
from flexgs_edge.io.formats import FORMATS
from flexgs_edge.io.geometry import read_geometry
from flexgs_edge.io.ply import PlySource
from flexgs_edge.io.spz import SH_STEP, refine_sh, sh_codes
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.methods.foreign.lower_sh import TrimmedSource
from flexgs_edge.report.results import CompressResult
from flexgs_edge.run.open_scene import open_scene
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource
from stopped import Stopped
from synthetic import random_scene
from tiny_project import COUNT, make_project

SUFFIXES = tuple(FORMATS)
FAST: dict[str, Any] = {"effort": "fast", "holdout": 4}
PAPER: dict[str, Any] = {"method": "paper", **FAST}
"""The quicker search, where a test is not about the method."""
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


@pytest.fixture(scope="module", autouse=True)
def converter() -> None:
    pytest.importorskip("gaussforge", reason="the extra [formats] is not installed")


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_project(tmp_path_factory.mktemp("tiny") / "scene", degree=2)


CASES = [(".spz", "paper"), (".spz", "best"), (".compressed.ply", "best"), (".sog", "paper")]


@pytest.fixture(scope="module", params=CASES, ids=lambda p: f"{p[0]}-{p[1]}")
def done(
    request: pytest.FixtureRequest, project: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, CompressResult]:
    """The tiny scene in every format, by both methods, at a drop of at most 2 dB."""
    suffix, method = request.param
    path = tmp_path_factory.mktemp("done") / f"a{suffix}"
    return path, compress(project / "point_cloud.ply", path, method=method, max_drop=2.0, **FAST)


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
    assert record["search"] and all(step["phase"] in ("line", "multiplier") for step in record["search"])
    text = result.summary()
    assert f"{result.size} bytes" in text and f".{record['format']}, SH degree {result.file_sh_degree}" in text
    assert info(path).format == record["format"] and info(path).count == result.count


def test_same_command_same_bytes(project: Path, done: tuple[Path, CompressResult], tmp_path: Path) -> None:
    path, result = done
    again = tmp_path / path.name
    limit = MemoryBudget.from_limit(None).used + 250 * 2**20
    compress(project / "point_cloud.ply", again, method=result.method, max_drop=2.0, memory_limit=limit, **FAST)
    data = again.read_bytes()
    assert data == path.read_bytes()
    if path.suffix == ".spz":
        assert data[:10] == bytes([31, 139, 8, 0, 0, 0, 0, 0, 2, 255]), "a name or a time in the gzip header"


@pytest.mark.parametrize(("suffix", "method"), [(".spz", "paper"), (".spz", "best"), (".compressed.ply", "paper")])
def test_finished_files_fit(project: Path, tmp_path: Path, suffix: str, method: str) -> None:
    path = tmp_path / f"a{suffix}"
    limit = 6000 if suffix == ".spz" else 7500
    result = compress(project / "point_cloud.ply", path, method=method, max_size=limit, **FAST)
    assert result.reached and 0.75 * limit < path.stat().st_size <= limit and result.size == path.stat().st_size


def test_out_of_reach(project: Path, tmp_path: Path) -> None:
    words = {**PAPER, "min_fidelity": 150.0}
    with pytest.raises(TargetError, match=r"fidelity >= 150 dB .*the closest point.*--best-effort"):
        compress(project / "point_cloud.ply", tmp_path / "a.spz", **words)
    assert list(tmp_path.iterdir()) == []
    closest = compress(project / "point_cloud.ply", tmp_path / "a.spz", best_effort=True, **words)
    assert closest.reached is False and closest.count == COUNT and "NOT reached" in closest.summary()


def test_without_writing(project: Path, tmp_path: Path, own_temporary_folder: Path) -> None:
    dry = compress(project / "point_cloud.ply", tmp_path / "a.spz", dry_run=True, max_drop=2.0, **PAPER)
    assert dry.output is None and dry.format == "spz" and [p.name for p in tmp_path.iterdir()] == ["tmp"]
    real = compress(project / "point_cloud.ply", tmp_path / "a.spz", max_drop=2.0, **PAPER)
    assert real.size == dry.size == (tmp_path / "a.spz").stat().st_size and real.quality == dry.quality
    assert list(own_temporary_folder.iterdir()) == []


def test_fixed_rates_and_scores_of_a_file(project: Path, tmp_path: Path) -> None:
    """Without cameras: rows go by the scores, SH too; nothing is measured."""
    scores = np.random.default_rng(1).permutation(COUNT).astype(np.float64)
    np.save(tmp_path / "s.npy", scores)
    lonely = tmp_path / "lonely.ply"
    lonely.write_bytes((project / "point_cloud.ply").read_bytes())
    words: dict[str, Any] = {"method": "paper", "score": str(tmp_path / "s.npy"), "prune_rate": 0.5, "cameras": "none"}
    result = compress(lonely, tmp_path / "a.spz", sh_rate=0.25, **words)
    assert (result.count, result.sh_count, result.quality, result.reached) == (COUNT // 2, COUNT // 4, None, None)
    bare = compress(lonely, tmp_path / "b.spz", sh_rate=0.5, **words)
    assert bare.file_sh_degree == 0 and bare.size < result.size
    kept = PlySource(lonely).read(np.flatnonzero(scores >= COUNT // 2), ["means"])["means"]
    found = read_foreign(tmp_path / "b.spz").read(slice(0, bare.count), ["means"])["means"]
    np.testing.assert_allclose(np.sort(found.sum(axis=0)), np.sort(kept.sum(axis=0)), atol=2.0**-10)


def test_scores_are_saved_and_training_poses_decide(project: Path, tmp_path: Path) -> None:
    saved = tmp_path / "s.npy"
    words = {**PAPER, "select": "train", "max_drop": 2.0, "score": "meson"}
    result = compress(project / "point_cloud.ply", tmp_path / "a.spz", save_scores=str(saved), **words)
    assert result.decision_views == "training" and result.quality_views == "held-out"
    assert result.scores_saved == str(saved) and np.load(saved).shape == (COUNT,)


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
        ("a.spz", {"bits": "rest=3"}, r"--bits: \.spz has precisions of its own"),
        ("a.sog", {"groups": 4}, r"--groups: \.sog has precisions of its own"),
        ("a.splat", {}, r"expected a name that ends in \.fgs, \.spz, \.sog, \.compressed\.ply"),
        ("none/a.spz", {}, "does not exist"),
        ("a.spz", {"memory_limit": 2**20}, r"--memory-limit \d+MiB or more"),
    ],
)
def test_what_is_refused(project: Path, tmp_path: Path, name: str, words: dict[str, Any], message: str) -> None:
    with pytest.raises((InputError, BudgetError), match=message):
        compress(project / "point_cloud.ply", tmp_path / name, **PAPER, **words)
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_left_behind(project: Path, tmp_path: Path) -> None:
    (tmp_path / "a.spz").write_text("earlier")
    with pytest.raises(InputError, match="the file exists"):
        compress(project / "point_cloud.ply", tmp_path / "a.spz", **PAPER)

    words = {"force": True, "progress": Stopped(enabled=False), **PAPER}
    with pytest.raises(KeyboardInterrupt):
        compress(project / "point_cloud.ply", tmp_path / "a.spz", **words)
    assert [path.name for path in tmp_path.iterdir()] == ["a.spz"] and (tmp_path / "a.spz").read_text() == "earlier"


def test_without_the_converter(project: Path, tmp_path: Path, without_converter: None) -> None:
    with pytest.raises(InputError, match=r"pip install 'flexgs-edge\[formats\]'"):
        compress(project / "point_cloud.ply", tmp_path / "b.spz", **PAPER)


def test_on_the_command_line(
    project: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = str(project / "point_cloud.ply")
    command = [
        "compress",
        scene,
        "-o",
        str(tmp_path / "a.spz"),
        "--method",
        "paper",
        "--min-fidelity",
        "150",
        "--effort",
        "fast",
    ]
    with pytest.raises(SystemExit) as caught:
        app.main([*command, "-q", "--holdout", "4"])
    assert caught.value.code == 3 and "the closest point is fidelity" in capsys.readouterr().err
    with pytest.raises(SystemExit) as caught:
        app.main(["decompress", scene, "-o", str(tmp_path / "a.compressed.ply"), "-q"])
    assert caught.value.code == 0 and "a.compressed.ply" in capsys.readouterr().out
    with pytest.raises(SystemExit) as caught:
        app.main(["info", str(tmp_path / "a.compressed.ply")])
    assert caught.value.code == 0 and f"{COUNT}, SH degree 2" in capsys.readouterr().out


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_geometry_comes_back_row_by_row(tmp_path: Path, suffix: str) -> None:
    source = random_scene(1500, seed=5, degree=2)
    found, rows = read_geometry(tmp_path, source, FORMATS[suffix])
    assert sorted(rows.tolist()) == list(range(1500)) and list(tmp_path.iterdir()) == []
    planes = source.read(slice(0, 1500), list(FIELD))
    means = found.read(slice(0, 1500), ["means"])["means"] + (found.origin - source.origin)[:, None]
    assert np.abs(means - planes["means"][:, rows]).max() < 0.02
    # The whole scene comes back with the same geometry.
    write_foreign(tmp_path / f"a{suffix}", source)
    whole = read_foreign(tmp_path / f"a{suffix}")
    for name in ("means", "log_scales", "quats", "opacity_logits"):
        one, two = (s.read(slice(0, 1500), [name])[name] for s in (found, whole))
        np.testing.assert_array_equal(one, two, err_msg=name)


def test_rows_along_the_curve_are_smaller(sample_dir: Path, tmp_path: Path) -> None:
    whole = PlySource(sample_dir / "point_cloud.ply")
    sizes = []
    for name, order in (("a.spz", np.arange(whole.count)), ("b.spz", near_order(whole))):
        write_foreign(tmp_path / name, TrimmedSource(whole.select(order), np.zeros(whole.count, bool), 0))
        sizes.append((tmp_path / name).stat().st_size)
    assert sizes[1] < 0.98 * sizes[0]


def test_sh_of_spz_have_our_step(tmp_path: Path) -> None:
    planes = random_scene(3000, seed=2, degree=3).read(slice(0, 3000), list(FIELD))
    source = MemorySource(planes, 3)
    write_foreign(tmp_path / "a.spz", source)
    sh = read_foreign(tmp_path / "a.spz").read(slice(0, 3000), ["sh_rest"])["sh_rest"]
    np.testing.assert_array_equal(sh, (sh_codes(planes["sh_rest"]) - 128) / np.float32(128))
    assert np.abs(sh - planes["sh_rest"])[np.abs(planes["sh_rest"]) < 0.9].max() <= SH_STEP / 256 + 1e-6


def test_spz_files_of_another_kind_are_refused(tmp_path: Path) -> None:
    source = random_scene(100, seed=2, degree=1)
    write_foreign(tmp_path / "a.spz", source)
    good = gzip.decompress((tmp_path / "a.spz").read_bytes())
    wrong_signs = good[:-900] + bytes(255 - code for code in good[-900:])
    for data in (good[:4] + b"\7" + good[5:], good[:-1], good + b"\0", good[:500], good[:10], wrong_signs):
        (tmp_path / "b").write_bytes(gzip.compress(data))
        with pytest.raises(InputError, match=r"converter's \.spz is not of a kind that this program knows"):
            refine_sh(tmp_path / "b", source, tmp_path / "c")
        (tmp_path / "c").unlink()
    (tmp_path / "b").write_bytes(b"no gzip at all")
    with pytest.raises(InputError, match="not of a kind"):
        refine_sh(tmp_path / "b", source, tmp_path / "c")


def test_gsply_sees_what_we_see(done: tuple[Path, CompressResult]) -> None:
    gsply = pytest.importorskip("gsply")
    path, result = done
    if path.suffix == ".sog":
        pytest.importorskip("imagecodecs", reason="gsply reads .sog through imagecodecs")
        found = gsply.sogread(str(path))
    else:
        found = gsply.read_spz(str(path)) if path.suffix == ".spz" else gsply.plyread(str(path))
    source = read_foreign(path)
    ours = source.read(slice(0, source.count), list(FIELD))
    theirs = {"means": found.means, "log_scales": found.scales, "sh_dc": found.sh0}
    if source.sh_degree:
        theirs["sh_rest"] = np.asarray(found.shN).transpose(0, 2, 1).reshape(source.count, -1)
    for name, values in theirs.items():
        np.testing.assert_allclose(np.asarray(values).T, ours[name], atol=1e-5, err_msg=name)
