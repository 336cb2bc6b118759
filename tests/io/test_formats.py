"""Other projects' formats: round trips within each format's own steps, read by another package as well, and what goes wrong."""

from __future__ import annotations

import gc
import gzip
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from flexgs_edge.errors import BudgetError, FormatError, InputError
from flexgs_edge.io.exchange import OPACITY_LIMIT, read_foreign, write_foreign
from flexgs_edge.io.formats import FORMATS, format_of
from flexgs_edge.io.ply import PlySource
from flexgs_edge.run.inputs import load_scene
from flexgs_edge.run.open_scene import open_scene
from flexgs_edge.scene.fields import FIELD, sh_rest_count
from flexgs_edge.scene.source import MemorySource, SceneSource

SUFFIXES = tuple(FORMATS)
pytestmark = [
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.usefixtures("own_temporary_folder"),
]


@pytest.fixture(scope="module", autouse=True)
def converter() -> None:
    pytest.importorskip("gaussforge", reason="the extra [formats] is not installed")


def scene(count: int = 700, degree: int = 3, seed: int = 0, far: float = 0.0) -> MemorySource:
    """Values that all formats can hold: opacities off 0 and 1, scales and colours inside spz's ranges."""
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(4, count)) * rng.uniform(0.4, 1.8, count)
    planes = {
        "means": rng.uniform(-3, 3, (3, count)),
        "sh_dc": rng.uniform(-1.5, 1.5, (3, count)),
        "sh_rest": rng.uniform(-0.2, 0.2, (3 * sh_rest_count(degree), count)),
        "opacity_logits": rng.uniform(-4, 4, (1, count)),
        "log_scales": rng.uniform(-6, 0, (3, count)),
        "quats": quats,
    }
    origin = np.array([far, 0.0, 0.0])
    return MemorySource({k: v.astype(np.float32) for k, v in planes.items()}, degree, origin)


def test_spz_says_that_a_model_is_antialiased(tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    write_foreign(path, scene(50, 1))
    assert load_scene(path).settings == {}
    packed = bytearray(gzip.decompress(path.read_bytes()))
    packed[14] |= 1
    path.write_bytes(gzip.compress(bytes(packed)))
    assert load_scene(path).settings == {"antialiased": True}


def planes_of(source: SceneSource) -> dict[str, np.ndarray]:
    planes = source.read(slice(0, source.count), list(FIELD))
    planes["means"] = planes["means"] + source.origin[:, None]
    return planes


def matched(ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The rows of `ours` in the order of `theirs`: formats sort, positions find the partners."""
    squares = ((ours["means"].T[None] - theirs["means"].T[:, None]) ** 2).sum(axis=2)
    rows = squares.argmin(axis=1)
    assert len(set(rows.tolist())) == len(rows), "two rows found the same partner"
    return {name: plane[:, rows] for name, plane in ours.items()}


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x.astype(np.float64)))


def degrees_apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    a, b = a / np.linalg.norm(a, axis=0), b / np.linalg.norm(b, axis=0)
    return np.degrees(2 * np.arccos(np.clip(np.abs((a * b).sum(axis=0)), 0, 1)))


# Half a step of each format, with room for float32: 8-bit opacities, 1/16 (spz), a 256-entry codebook (sog) or 11 bits of a
# chunk's range (compressed.ply) for scales, and so on. SH of .sog are vectors of a codebook: bound by the spread of the scene.
BOUNDS = {
    ".spz": {
        "means": 2.0**-13,
        "opacity": 0.6 / 255,
        "log_scales": 0.032,
        "sh_dc": 0.014,
        "sh_rest": 0.032,
        "degrees": 0.3,
    },
    ".sog": {"means": 5e-4, "opacity": 0.6 / 255, "log_scales": 0.04, "sh_dc": 0.02, "sh_rest": 0.41, "degrees": 1.0},
    ".compressed.ply": {
        "means": 4e-3,
        "opacity": 0.6 / 255,
        "log_scales": 4e-3,
        "sh_dc": 0.008,
        "sh_rest": 0.035,
        "degrees": 0.3,
    },
}


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_round_trips(tmp_path: Path, suffix: str, degree: int) -> None:
    source = scene(degree=degree)
    path = tmp_path / f"scene{suffix}"
    assert write_foreign(path, source) == ()
    assert path.stat().st_size < 0.8 * source.count * 4 * (14 + source.width("sh_rest"))
    back = open_scene(path)
    assert (back.count, back.sh_degree, back.name) == (source.count, degree, str(path))
    theirs = planes_of(back)
    ours, bounds = matched(planes_of(source), theirs), BOUNDS[suffix]
    for field in ("means", "log_scales", "sh_dc", "sh_rest"):
        error = np.abs(ours[field] - theirs[field]).max(initial=0.0)
        assert error <= bounds[field], f"{field}: {error}"
    assert np.abs(sigmoid(ours["opacity_logits"]) - sigmoid(theirs["opacity_logits"])).max() <= bounds["opacity"]
    assert degrees_apart(ours["quats"], theirs["quats"]).max() <= bounds["degrees"]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_another_reader_sees_the_same_scene(tmp_path: Path, suffix: str) -> None:
    gsply = pytest.importorskip("gsply")
    source = scene(degree=3, seed=1)
    path = tmp_path / f"scene{suffix}"
    write_foreign(path, source)
    if suffix == ".sog":
        pytest.importorskip("imagecodecs", reason="gsply reads .sog through imagecodecs")
        found = gsply.sogread(str(path))
    else:
        found = gsply.read_spz(str(path)) if suffix == ".spz" else gsply.plyread(str(path))
    ours = planes_of(read_foreign(path))
    np.testing.assert_allclose(np.asarray(found.means).T, ours["means"], atol=1e-5)
    np.testing.assert_allclose(np.asarray(found.scales).T, ours["log_scales"], atol=1e-5)
    np.testing.assert_allclose(np.asarray(found.sh0).T, ours["sh_dc"], atol=1e-5)
    np.testing.assert_allclose(np.asarray(found.shN).transpose(2, 1, 0).reshape(45, -1), ours["sh_rest"], atol=1e-5)
    np.testing.assert_allclose(
        sigmoid(np.asarray(found.opacities).reshape(1, -1)), sigmoid(ours["opacity_logits"]), atol=1e-4
    )
    assert degrees_apart(np.asarray(found.quats).T, ours["quats"]).max() < 0.1


@pytest.mark.parametrize("suffix", [".spz", ".compressed.ply"])
def test_the_sample(tmp_path: Path, sample_dir: Path, suffix: str) -> None:
    path = tmp_path / f"sample{suffix}"
    source = PlySource(sample_dir / "point_cloud.ply")
    write_foreign(path, source)
    back = read_foreign(path)
    assert back.count == source.count and path.stat().st_size < 0.3 * source.count * 248
    for field in ("means", "opacity_logits", "log_scales", "sh_dc", "sh_rest", "quats"):
        assert np.isfinite(back.read(slice(0, back.count), [field])[field]).all(), field
    # .spz keeps the order of rows.
    if suffix == ".spz":
        assert np.abs(planes_of(back)["means"] - planes_of(source)["means"]).max() <= 2.0**-12


def test_the_longest_suffix_wins(tmp_path: Path) -> None:
    assert [format_of(name) and format_of(name).suffix for name in ("a.SPZ", "b.compressed.ply", "c.ply", "d.sog", "spz")] == [
        ".spz", ".compressed.ply", None, ".sog", None,
    ]  # fmt: skip
    write_foreign(tmp_path / "A.Compressed.PLY", scene(300))
    assert open_scene(tmp_path / "A.Compressed.PLY").count == 300
    with pytest.raises(InputError, match=r"expected a file ending in .spz, .sog, .compressed.ply"):
        write_foreign(tmp_path / "a.ply", scene(3))
    with pytest.raises(InputError, match=r"expected a file ending in"):
        read_foreign(tmp_path / "a.ply")


def test_opacities_of_zero_and_one_stay_finite(tmp_path: Path) -> None:
    source = scene(4)
    planes = planes_of(source)
    planes["opacity_logits"][0] = [-20.0, 20.0, 0.0, 4.0]
    write_foreign(tmp_path / "a.spz", MemorySource(planes))
    logits = read_foreign(tmp_path / "a.spz").read(slice(0, 4), ["opacity_logits"])["opacity_logits"][0]
    np.testing.assert_array_equal(logits[:2], [-OPACITY_LIMIT, OPACITY_LIMIT])
    # Less than half of the format's step away from what the format means.
    assert sigmoid(logits)[0] < 0.5 / 255 and sigmoid(logits)[1] > 254.5 / 255


def test_scenes_far_from_zero(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a.spz: .spz holds coordinates up to 2048; row 0 of memory lies at 500"):
        write_foreign(tmp_path / "a.spz", scene(50, far=5000.0))
    notes = write_foreign(tmp_path / "a.compressed.ply", scene(50, far=5000.0))
    assert notes == ("positions rounded to float32: the scene is far from zero",)
    means = planes_of(read_foreign(tmp_path / "a.compressed.ply"))["means"]
    assert 4996 < means[0].min() < means[0].max() < 5004
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.compressed.ply", "tmp"]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_cannot_be_written(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    with pytest.raises(InputError, match="SH up to degree 3, this scene has 4"):
        write_foreign(path, scene(3, degree=4))
    with pytest.raises(InputError, match="the scene is empty"):
        write_foreign(path, scene(0))
    with pytest.raises(InputError, match="does not exist"):
        write_foreign(tmp_path / "none" / f"a{suffix}", scene(3))
    path.write_bytes(b"earlier")
    with pytest.raises(InputError, match="the file exists"):
        write_foreign(path, scene(3))
    assert path.read_bytes() == b"earlier"
    write_foreign(path, scene(3), force=True)
    assert read_foreign(path).count == 3
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([path.name, "tmp"])


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_damaged_files(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    write_foreign(path, scene(300))
    good = path.read_bytes()
    for data in (b"", b"abc", good[: len(good) // 2], b"\0" * 1000):
        path.write_bytes(data)
        with pytest.raises(FormatError) as caught:
            read_foreign(path)
        assert str(path) in str(caught.value)
    path.unlink()
    with pytest.raises(InputError, match="no such"):
        read_foreign(path)
    assert list((tmp_path / "tmp").iterdir()) == []


def test_the_expanded_scene_goes_with_the_source(tmp_path: Path) -> None:
    write_foreign(tmp_path / "a.spz", scene(5))
    source = read_foreign(tmp_path / "a.spz")
    part = source.select(np.array([3, 1]))
    assert len(list((tmp_path / "tmp").iterdir())) == 1
    del source
    gc.collect()
    assert part.read(slice(0, 2), ["means"])["means"].shape == (3, 2)
    del part
    gc.collect()
    assert list((tmp_path / "tmp").iterdir()) == []


def test_nothing_is_printed(tmp_path: Path) -> None:
    write_foreign(tmp_path / "a.spz", scene(5))
    code = "import sys; from flexgs_edge.io.exchange import read_foreign; print(read_foreign(sys.argv[1]).count)"
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "a.spz")], capture_output=True, text=True, check=True
    )
    assert (done.stdout, done.stderr) == ("5\n", "")


def test_without_the_converter(tmp_path: Path, without_converter: None) -> None:
    for job in (lambda: read_foreign(tmp_path / "a.spz"), lambda: write_foreign(tmp_path / "a.spz", scene(3))):
        with pytest.raises(InputError, match=r"pip install 'flexgs-edge\[formats\]'"):
            job()


@pytest.mark.parametrize(
    ("code", "error", "words"),
    [
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", FormatError, r"crashed \(signal 11\)"),
        ("raise MemoryError", BudgetError, "memory does not suffice"),
        ("raise OSError(28, 'No space left on device')", BudgetError, "the disk is full"),
        ("raise ImportError('libfoo.so')", InputError, "gaussforge failed: ImportError: libfoo.so"),
        ("import sys; sys.exit(7)", InputError, "gaussforge failed: exit code 7"),
    ],
)
def test_a_converter_that_breaks_down(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str, error: type[Exception], words: str
) -> None:
    """What its process imports is a package of this name that does so."""
    (tmp_path / "packages").mkdir()
    (tmp_path / "packages" / "gaussforge.py").write_text(code)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "packages"))
    with pytest.raises(error, match=words):
        write_foreign(tmp_path / "a.spz", scene(3))
    assert (
        sorted(p.name for p in tmp_path.iterdir()) == ["packages", "tmp"] and list((tmp_path / "tmp").iterdir()) == []
    )
