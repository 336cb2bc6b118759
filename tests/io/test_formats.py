"""Other programs' formats: round trips within each format's own steps, frames, and what cannot be written or read."""

from __future__ import annotations

import gzip
import subprocess
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from flexgs_edge.api.scene import Scene
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.errors import FormatError, InputError
from flexgs_edge.io.decoded import OPACITY_LIMIT
from flexgs_edge.io.exchange import near_order, read_foreign, write_foreign
from flexgs_edge.io.formats import FORMATS, WRITTEN, format_of, written_format
from flexgs_edge.io.frames import RDF, RUB, in_frame
from flexgs_edge.io.ply import PlySource, write_ply
from flexgs_edge.io.reading import Reading, Writing
from flexgs_edge.quality.psnr import mse, psnr
from flexgs_edge.run.inputs import load_scene
from flexgs_edge.scene.fields import FIELD, sh_rest_count
from flexgs_edge.scene.rotations import matrices
from flexgs_edge.scene.source import MemorySource, SceneSource
from scene_files import open_scene

pytestmark = pytest.mark.usefixtures("own_temporary_folder")


def scene(count: int = 700, degree: int = 3, seed: int = 0, far: float = 0.0) -> MemorySource:
    """Values that all formats can hold: opacities off 0 and 1, scales and colours inside every range."""
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


def planes_of(source: SceneSource) -> dict[str, np.ndarray]:
    planes = source.read(slice(0, source.count), list(FIELD))
    planes["means"] = planes["means"] + source.origin[:, None]
    return planes


def matched(ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The rows of `ours` in the order of `theirs`: files are sorted, positions find the partners."""
    squares = ((ours["means"].T[None] - theirs["means"].T[:, None]) ** 2).sum(axis=2)
    rows = squares.argmin(axis=1)
    assert len(set(rows.tolist())) == len(rows), "two rows found the same partner"
    return {name: plane[:, rows] for name, plane in ours.items()}


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x.astype(np.float64)))


def degrees_apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    a, b = a.astype(np.float64), b.astype(np.float64)
    a, b = a / np.linalg.norm(a, axis=0), b / np.linalg.norm(b, axis=0)
    return np.degrees(2 * np.arccos(np.clip(np.abs((a * b).sum(axis=0)), 0, 1)))


def shape_of(planes: dict[str, np.ndarray]) -> np.ndarray:
    """[n, 3, 3], covariances over their largest entry."""
    axes = matrices(planes["quats"]) * np.exp(planes["log_scales"].astype(np.float64)).T[:, None]
    found = axes @ axes.transpose(0, 2, 1)
    return found / np.abs(found).max(axis=(1, 2), keepdims=True)


# Half a step of each format, with room for float32. SH of .sog are vectors of a codebook: bound by the spread of the scene.
BOUNDS = {
    ".spz": {"means": 2.0**-13, "log_scales": 0.032, "sh_dc": 0.014, "sh_rest": 0.032, "degrees": 0.3},
    ".sog": {"means": 5e-4, "log_scales": 0.04, "sh_dc": 0.02, "sh_rest": 0.41, "degrees": 1.0},
    ".compressed.ply": {"means": 4e-3, "log_scales": 4e-3, "sh_dc": 0.008, "sh_rest": 0.035, "degrees": 0.3},
    ".splat": {"means": 1e-6, "log_scales": 1e-5, "sh_dc": 0.008, "sh_rest": 0.0, "degrees": 1.0},
    ".glb": {"means": 1e-6, "log_scales": 1e-5, "sh_dc": 1e-6, "sh_rest": 1e-6, "degrees": 0.1},
}
MISSING = pytest.mark.skipif(find_spec("pxr") is None, reason="no usd-core here: pip install flexgs-edge[usd]")
HERE = [pytest.param(suffix, marks=MISSING if FORMATS[suffix].needs else ()) for suffix in WRITTEN]


def limited(degree: int, suffix: str) -> int:
    """The SH degree that a file keeps."""
    return min(degree, FORMATS[suffix].max_degree)


@pytest.mark.parametrize("suffix", HERE)
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_round_trips(tmp_path: Path, suffix: str, degree: int) -> None:
    source = scene(degree=degree)
    path = tmp_path / f"scene{suffix}"
    kept = limited(degree, suffix)
    notes = write_foreign(path, source)
    assert notes == (() if kept == degree else (f"SH above degree {kept} left out: {suffix} holds no others",))
    if suffix != ".usda":  # a text
        assert path.stat().st_size < 1.1 * source.count * 4 * (14 + source.width("sh_rest")) + 4096
    back = open_scene(path)
    assert (back.count, back.sh_degree, back.name) == (source.count, kept, str(path))
    theirs = planes_of(back)
    ours, bounds = matched(planes_of(source), theirs), BOUNDS.get(suffix, BOUNDS[".glb"])
    if kept < degree:
        ours["sh_rest"] = theirs["sh_rest"]
    if suffix == ".sog":  # whose writer turns a Gaussian's axes; the shape stays
        shapes = [shape_of(planes) for planes in (ours, theirs)]
        assert np.abs(shapes[0] - shapes[1]).max() < 0.08
        ours["log_scales"], theirs["log_scales"] = (np.sort(p["log_scales"], axis=0) for p in (ours, theirs))
        ours["quats"] = theirs["quats"]
    for field in ("means", "log_scales", "sh_dc", "sh_rest"):
        error = np.abs(ours[field] - theirs[field]).max(initial=0.0)
        assert error <= bounds[field], f"{field}: {error}"
    assert np.abs(sigmoid(ours["opacity_logits"]) - sigmoid(theirs["opacity_logits"])).max() <= 0.6 / 255
    assert degrees_apart(ours["quats"], theirs["quats"]).max() <= bounds["degrees"]


def camera() -> Camera:
    """Looks at the scenes of these tests from in front and above, a little from the side."""
    forward = np.array([0.2, 0.3, 1.0]) / np.linalg.norm([0.2, 0.3, 1.0])
    right = np.cross(np.array([0.0, 1.0, 0.0]), forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Camera("a", 96, 64, rotation, -rotation @ np.array([-1.5, -2.5, -8.0]), 90.0, 90.0, 47.5, 31.5)


@pytest.mark.parametrize("suffix", [".ply", *HERE])
def test_one_scene_looks_the_same_in_every_format(tmp_path: Path, suffix: str) -> None:
    """Strong view-dependent colour, drawn from one camera: not mirrored, the same way up, the same colours."""
    source = scene(60, degree=limited(2, suffix) if suffix in FORMATS else 2)
    planes = planes_of(source)
    planes["sh_rest"] *= 2.0
    planes["log_scales"] += 2.0
    write_ply(tmp_path / "plain.ply", MemorySource(planes))
    path = tmp_path / f"a{suffix}"
    if suffix != ".ply":
        write_foreign(path, MemorySource(planes))
    else:
        write_ply(path, MemorySource(planes))
    drawn = [Scene.open(place).render(camera()) for place in (tmp_path / "plain.ply", path)]
    assert drawn[0].std() > 0.1
    found = psnr(mse(*drawn))
    assert found is None or found > 40.0
    mirrored = psnr(mse(drawn[0], drawn[1][:, ::-1]))
    upside_down = psnr(mse(drawn[0], drawn[1][::-1]))
    assert mirrored is not None and mirrored < 25.0 and upside_down is not None and upside_down < 25.0


def test_frame_says_how_a_file_breaks_its_rule(tmp_path: Path) -> None:
    source = scene(20, degree=1)
    write_foreign(tmp_path / "right.spz", source)
    write_foreign(tmp_path / "wrong.spz", in_frame(source, RUB))
    right, wrong = open_scene(tmp_path / "right.spz"), open_scene(tmp_path / "wrong.spz", Reading.of("rdf"))
    theirs = planes_of(right)
    ours = matched(planes_of(wrong), theirs)
    for field in ("means", "sh_rest"):
        np.testing.assert_array_equal(ours[field], theirs[field])
    assert degrees_apart(ours["quats"], theirs["quats"]).max() < 0.3
    with pytest.raises(InputError, match=r"frame 'RXB': expected three letters"):
        Reading.of("RXB")


@pytest.mark.parametrize("suffix", [suffix for suffix, format in FORMATS.items() if format.marks_antialiased])
@pytest.mark.parametrize("version", [3, 4])
def test_antialiased_models_stay_so(tmp_path: Path, suffix: str, version: int) -> None:
    path = tmp_path / f"a{suffix}"
    write_foreign(path, scene(50, 1), writing=Writing(version, antialiased=True))
    assert load_scene(path).settings == {"antialiased": True}
    write_foreign(path, scene(50, 1), writing=Writing(version), force=True)
    assert load_scene(path).settings.get("antialiased", False) is False


@pytest.mark.parametrize("suffix", [".spz", ".compressed.ply", ".splat", ".glb"])
def test_the_sample(tmp_path: Path, sample_dir: Path, suffix: str) -> None:
    path = tmp_path / f"sample{suffix}"
    source = PlySource(sample_dir / "point_cloud.ply")
    write_foreign(path, source)
    back = read_foreign(path)
    assert back.count == source.count and path.stat().st_size <= 0.96 * source.count * 248
    for field in ("means", "opacity_logits", "log_scales", "sh_dc", "sh_rest", "quats"):
        assert np.isfinite(back.read(slice(0, back.count), [field])[field]).all(), field


@pytest.mark.parametrize("suffix", HERE)
def test_same_scene_same_bytes(tmp_path: Path, suffix: str) -> None:
    for name in ("a", "b"):
        write_foreign(tmp_path / f"{name}{suffix}", scene(300, limited(2, suffix)))
    assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()


def test_the_longest_suffix_wins(tmp_path: Path) -> None:
    names = ("a.SPZ", "b.compressed.ply", "c.ply", "d.sog", "spz", "lod-meta.json", "meta.json", "e.glb", "f.ksplat")
    assert [format_of(name) and format_of(name).suffix for name in names] == [
        ".spz", ".compressed.ply", None, ".sog", None, "lod-meta.json", "meta.json", ".glb", ".ksplat",
    ]  # fmt: skip
    write_foreign(tmp_path / "A.Compressed.PLY", scene(300))
    assert open_scene(tmp_path / "A.Compressed.PLY").count == 300
    with pytest.raises(InputError, match=r"-o a.ksplat: .ksplat files are only read; write one of .spz, .sog"):
        written_format("a.ksplat")


def test_every_reader_and_writer_is_there() -> None:
    for format in FORMATS.values():
        for place in (format.reader, format.writer):
            if place is not None:
                module, _, name = place.partition(":")
                assert callable(getattr(import_module(module), name))


@pytest.mark.parametrize("suffix", [".spz", ".sog", ".compressed.ply", ".splat"])
def test_opacities_of_zero_and_one_stay_finite(tmp_path: Path, suffix: str) -> None:
    planes = planes_of(scene(4, degree=0))
    planes["opacity_logits"][0] = [-20.0, 20.0, 0.0, 4.0]
    write_foreign(tmp_path / f"a{suffix}", MemorySource(planes))
    logits = np.sort(read_foreign(tmp_path / f"a{suffix}").read(slice(0, 4), ["opacity_logits"])["opacity_logits"][0])
    np.testing.assert_array_equal(logits[[0, 3]], [-OPACITY_LIMIT, OPACITY_LIMIT])
    # Less than half of the format's step away from what the format means.
    assert sigmoid(logits)[0] < 0.5 / 255 and sigmoid(logits)[3] > 254.5 / 255


@pytest.mark.parametrize("suffix", [".compressed.ply", ".splat", ".spz"])
def test_scenes_far_from_zero(tmp_path: Path, suffix: str) -> None:
    notes = write_foreign(tmp_path / f"a{suffix}", scene(50, 0, far=5000.0))
    assert notes == ("positions rounded to float32: the scene is far from zero",)
    means = planes_of(read_foreign(tmp_path / f"a{suffix}"))["means"]
    assert 4996 < means[0].min() < means[0].max() < 5004


@pytest.mark.parametrize("suffix", HERE)
def test_what_cannot_be_written(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
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


@pytest.mark.parametrize("suffix", HERE)
def test_damaged_files(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    write_foreign(path, scene(300))
    good = path.read_bytes()
    wrong = [b"", b"abc", good[: len(good) // 2 + 3]]
    if suffix != ".splat":  # which has no magic: 32 zeros are a Gaussian
        wrong.append(b"\0" * 1000)
    for data in wrong:
        path.write_bytes(data)
        with pytest.raises(FormatError) as caught:
            load_scene(path)
        assert str(path) in str(caught.value)
    path.unlink()
    with pytest.raises(InputError, match="no such"):
        read_foreign(path)
    assert list((tmp_path / "tmp").iterdir()) == []


@pytest.mark.parametrize("suffix", [".ply", *HERE])
def test_packed_with_gzip(tmp_path: Path, suffix: str) -> None:
    plain = tmp_path / f"a{suffix}"
    if suffix == ".ply":
        write_ply(plain, scene(30, 0))
    else:
        write_foreign(plain, scene(30, 0))
    packed = tmp_path / f"a{suffix}.gz"
    packed.write_bytes(gzip.compress(plain.read_bytes()))
    ours, theirs = planes_of(open_scene(packed)), planes_of(open_scene(plain))
    for field, values in theirs.items():
        np.testing.assert_array_equal(ours[field], values)
    assert open_scene(packed).name == str(packed)
    if suffix == ".usdz":  # usd-core needs no end of an archive
        return
    packed.write_bytes(gzip.compress(plain.read_bytes()[:-7]))
    with pytest.raises(FormatError) as caught:
        open_scene(packed).read(slice(0, 1), ["means"])
    assert str(packed) in str(caught.value) and str(tmp_path / "tmp") not in str(caught.value)


@pytest.mark.parametrize("suffix", HERE)
def test_the_source_does_not_need_its_file(tmp_path: Path, suffix: str) -> None:
    """Searches read files back and remove them."""
    path = tmp_path / f"a{suffix}"
    write_foreign(path, scene(5, 0))
    source = read_foreign(path)
    assert source.held_bytes > 0
    path.unlink()
    assert source.read(slice(0, 5), ["means"])["means"].shape == (3, 5)


def test_nothing_is_printed(tmp_path: Path) -> None:
    write_foreign(tmp_path / "a.spz", scene(5))
    code = "import sys; from flexgs_edge.io.exchange import read_foreign; print(read_foreign(sys.argv[1]).count)"
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "a.spz")], capture_output=True, text=True, check=True
    )
    assert (done.stdout, done.stderr) == ("5\n", "")


@pytest.mark.parametrize("suffix", [".spz", ".sog", ".compressed.ply"])
def test_another_reader_sees_the_same_scene(tmp_path: Path, suffix: str) -> None:
    gsply = pytest.importorskip("gsply")
    path = tmp_path / f"scene{suffix}"
    write_foreign(path, scene(degree=3, seed=1))
    if suffix == ".sog":
        pytest.importorskip("imagecodecs", reason="gsply reads .sog through imagecodecs")
        found = gsply.sogread(str(path))
    else:
        found = gsply.read_spz(str(path)) if suffix == ".spz" else gsply.plyread(str(path))
    # That reader gives the values as they stand in the file, in the file's frame.
    ours = planes_of(read_foreign(path, Reading(frame=RDF)))
    np.testing.assert_allclose(np.asarray(found.means).T, ours["means"], atol=1e-5)
    np.testing.assert_allclose(np.asarray(found.scales).T, ours["log_scales"], atol=1e-5)
    np.testing.assert_allclose(np.asarray(found.sh0).T, ours["sh_dc"], atol=1e-5)
    np.testing.assert_allclose(np.asarray(found.shN).transpose(2, 1, 0).reshape(45, -1), ours["sh_rest"], atol=1e-5)
    np.testing.assert_allclose(
        sigmoid(np.asarray(found.opacities).reshape(1, -1)), sigmoid(ours["opacity_logits"]), atol=1e-4
    )
    assert degrees_apart(np.asarray(found.quats).T, ours["quats"]).max() < 0.1


def _utm() -> MemorySource:
    return MemorySource(planes_of(scene(300, 0)), origin=[482312.0, 5456784.0, 312.0])


@pytest.mark.parametrize("suffix", [".compressed.ply", ".splat", ".spz", ".sog"])
def test_positions_that_a_format_cannot_hold_are_refused(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    with pytest.raises(InputError, match=r"holds these coordinates only to [\d.e+]+, and the smallest splat"):
        write_foreign(path, _utm())
    assert not path.exists()
    assert write_foreign(path, _utm(), writing=Writing(force_lossy=True))[-1].startswith("positions rounded")


def test_a_glb_holds_the_origin_exactly(tmp_path: Path) -> None:
    source = _utm()
    assert write_foreign(tmp_path / "a.glb", source) == ()
    back, rows = read_foreign(tmp_path / "a.glb"), near_order(source)
    every = slice(0, source.count)
    means = back.read(every, ["means"])["means"] + back.origin[:, None]
    expected = source.read(every, ["means"])["means"][:, rows] + source.origin[:, None]
    np.testing.assert_allclose(means, expected, rtol=0, atol=1e-5)


def test_far_rows_come_last_by_octaves() -> None:
    near = planes_of(scene(600, 0))
    order = near_order(MemorySource(near))
    means = near["means"].copy()
    means[:, 7::100] *= 1e6
    moved = near_order(MemorySource(near | {"means": means}))
    assert set(moved[-6:]) == set(range(7, 600, 100)) and set(order[-6:]) != set(moved[-6:])
