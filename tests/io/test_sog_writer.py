"""Writing SOG scenes: within half a step of each field, the same bytes every time, and read alike by other programs."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

from flexgs_edge.errors import InputError
from flexgs_edge.io.codes import SMALLER, rounded_quats, unpack_small
from flexgs_edge.io.exchange import near_order, read_foreign, write_foreign
from flexgs_edge.io.formats import FORMATS
from flexgs_edge.io.frames import RUB, in_frame
from flexgs_edge.io.reading import Writing
from flexgs_edge.io.sog_writer import palette_size, write_sog
from flexgs_edge.scene.fields import FIELD, sh_rest_count
from flexgs_edge.scene.rotations import normalize_quats, turned
from flexgs_edge.scene.source import MemorySource, Planes, Rows, SceneSource


def scene(count: int, degree: int = 3, seed: int = 0, kinds: int = 0) -> MemorySource:
    """Random values; `kinds`: only so many different vectors of SH."""
    rng = np.random.default_rng(seed)
    rest = rng.normal(0, 0.2, (3 * sh_rest_count(degree), kinds or count))
    planes = {
        "means": rng.normal(0, 3, (3, count)),
        "sh_dc": rng.uniform(-1.5, 1.5, (3, count)),
        "sh_rest": rest[:, rng.integers(0, kinds, count)] if kinds else rest,
        "opacity_logits": rng.uniform(-5, 5, (1, count)),
        "log_scales": rng.uniform(-6, 0, (3, count)),
        "quats": rng.normal(size=(4, count)),
    }
    return MemorySource({name: plane.astype(np.float32) for name, plane in planes.items()}, degree)


def back_and_forth(path: Path, source: SceneSource, writing: Writing | None = None) -> tuple[Planes, Planes]:
    """The values of a scene in the order of its file, and those of the file."""
    write_foreign(path, source, force=True, writing=writing or Writing())
    back = read_foreign(path)
    assert (back.count, back.sh_degree) == (source.count, source.sh_degree)
    every = slice(0, source.count)
    return source.select(near_order(source)).read(every, list(FIELD)), back.read(every, list(FIELD))


def sigmoid(logits: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-logits.astype(np.float64)))


def covariances(planes: Planes) -> np.ndarray:
    """[n, 3, 3]"""
    count = planes["quats"].shape[1]
    axes = np.stack([turned(planes["quats"], np.eye(3)[:, [axis]] * np.ones(count)) for axis in range(3)])
    scaled = axes * np.exp(planes["log_scales"])[:, None]
    return np.einsum("ain,ajn->nij", scaled, scaled)


@pytest.mark.parametrize(
    ("count", "degree"), [(1, 3), (2, 1), (3, 2), (15, 0), (16, 3), (17, 3), (255, 1), (257, 2), (700, 3)]
)
def test_round_trips(tmp_path: Path, count: int, degree: int) -> None:
    source = scene(count, degree, seed=count)
    ours, theirs = back_and_forth(tmp_path / "a.sog", source)
    log = {k: np.copysign(np.log1p(np.abs(v["means"])), v["means"]) for k, v in (("ours", ours), ("theirs", theirs))}
    step = np.ptp(log["ours"], axis=1, keepdims=True) / 65535
    assert (np.abs(log["ours"] - log["theirs"]) <= 0.51 * step + 1e-6).all()
    assert np.abs(sigmoid(ours["opacity_logits"]) - sigmoid(theirs["opacity_logits"])).max() <= 0.501 / 255 + 5e-4
    # A codebook of 256 values over an even spread: half of a step, with room for the ends. Axes may change places.
    assert np.abs(np.sort(ours["log_scales"], axis=0) - np.sort(theirs["log_scales"], axis=0)).max() <= 1.5 * 6 / 256
    assert np.abs(ours["sh_dc"] - theirs["sh_dc"]).max() <= 1.5 * 3 / 256
    shapes = covariances(ours)
    assert (
        np.linalg.norm(shapes - covariances(theirs), axis=(1, 2)) < 0.06 * np.linalg.norm(shapes, axis=(1, 2))
    ).all()
    if degree and count > 3:
        # Noise has no clusters: from as many entries as half of the rows or more, two thirds of the square must come back.
        error = np.square(ours["sh_rest"] - theirs["sh_rest"]).sum() / np.square(ours["sh_rest"]).sum()
        assert error < (0.34 if count > palette_size(count) else 1e-3)


def test_forms_round_better_than_the_given_ones() -> None:
    """Thin discs and needles move less than half as far, as squares, as with the nearest codes of their own form."""
    planes = scene(3000, 0).read(slice(0, 3000), ["quats", "log_scales"])
    quats = normalize_quats(planes["quats"]).T.astype(np.float64)
    codes, mode, axes = rounded_quats(quats, planes["log_scales"].T)
    chosen = {
        "quats": unpack_small(codes, mode).T,
        "log_scales": np.take_along_axis(planes["log_scales"].T, axes, axis=1).T,
    }
    place = np.abs(quats).argmax(axis=1)
    signs = np.where(np.take_along_axis(quats, place[:, None], axis=1) < 0, -1, 1)
    small = np.rint((np.take_along_axis(quats * signs, SMALLER[place], axis=1) * np.sqrt(0.5) + 0.5) * 255)
    nearest = {"quats": unpack_small(small, place).T, "log_scales": planes["log_scales"]}
    exact = covariances(planes)
    errors = [
        np.square(covariances(some) - exact).sum(axis=(1, 2)) / np.square(exact).sum(axis=(1, 2))
        for some in (chosen, nearest)
    ]
    assert errors[0].mean() < 0.5 * errors[1].mean()


def test_few_different_vectors_come_back_nearly_exactly(tmp_path: Path) -> None:
    ours, theirs = back_and_forth(tmp_path / "a.sog", scene(2000, 3, kinds=200))
    assert np.abs(ours["sh_rest"] - theirs["sh_rest"]).max() < 0.03
    assert np.sqrt(np.square(ours["sh_rest"] - theirs["sh_rest"]).mean()) < 0.003


def test_rows_without_sh_stay_so(tmp_path: Path) -> None:
    planes = scene(600, 2).read(slice(0, 600), list(FIELD))
    planes["sh_rest"][:, ::3] = 0
    ours, theirs = back_and_forth(tmp_path / "a.sog", MemorySource(planes))
    dark = ~ours["sh_rest"].any(axis=0)
    assert dark.sum() == 200 and not theirs["sh_rest"][:, dark].any() and theirs["sh_rest"][:, ~dark].any(axis=0).all()


def test_values_at_the_ends(tmp_path: Path) -> None:
    """Opacities of 0 and 1, equal positions, far ones, one quaternion component of 1."""
    planes = scene(40, 1).read(slice(0, 40), list(FIELD))
    planes["opacity_logits"][0, :3] = [-60, 60, 0]
    planes["means"][0], planes["means"][1, 0], planes["means"][2] = 1.25, 1e6, 0
    planes["quats"][:] = 0
    planes["quats"][2] = -3
    planes["log_scales"][:] = -2.5
    ours, theirs = back_and_forth(tmp_path / "a.sog", MemorySource(planes))
    np.testing.assert_allclose(
        sigmoid(theirs["opacity_logits"]), sigmoid(ours["opacity_logits"]), atol=0.5 / 255 + 5e-4
    )
    np.testing.assert_allclose(theirs["means"][[0, 2]], ours["means"][[0, 2]], rtol=1e-6)
    np.testing.assert_allclose(theirs["means"][1], ours["means"][1], rtol=2e-4, atol=2e-4)
    np.testing.assert_allclose(covariances(theirs), covariances(ours), atol=1e-4)
    np.testing.assert_array_equal(theirs["log_scales"], ours["log_scales"])


def test_the_antialias_mark(tmp_path: Path) -> None:
    for antialiased in (False, True):
        write_foreign(tmp_path / "a.sog", scene(5), force=True, writing=Writing(antialiased=antialiased))
        assert dict(read_foreign(tmp_path / "a.sog").settings) == ({"antialiased": True} if antialiased else {})
    assert FORMATS[".sog"].marks_antialiased


def test_the_same_bytes_whatever_the_chunks(tmp_path: Path) -> None:
    """And nothing of the day or the machine in the zip."""
    source = scene(900, 2)

    class InSmallChunks(SceneSource):
        name, count, sh_degree, sh_count, origin = "small", 900, 2, 900, np.zeros(3)

        def read(self, rows: Rows, fields: object, out: Planes | None = None) -> Planes:
            return source.read(rows, list(fields), out)  # type: ignore[call-overload]

        def chunks(self, rows: int) -> object:  # type: ignore[override]
            return super().chunks(min(rows, 77))

    made = []
    for one in (source, source, InSmallChunks()):
        file = io.BytesIO()
        write_sog(file, one, Writing())
        made.append(file.getvalue())
    assert made[0] == made[1] == made[2]
    with zipfile.ZipFile(io.BytesIO(made[0])) as archive:
        infos = archive.infolist()
        meta = json.loads(archive.read("meta.json"))
    assert {info.date_time for info in infos} == {(1980, 1, 1, 0, 0, 0)} and {info.compress_type for info in infos} == {
        0
    }
    assert {len(meta[part]["codebook"]) for part in ("scales", "sh0", "shN")} == {256}
    assert meta["shN"]["count"] <= 900 == meta["count"]


def test_strong_sh_keep_their_frame(tmp_path: Path) -> None:
    """A scene in another frame comes back with each coefficient in its place and with its sign."""
    source = in_frame(scene(64, 3, kinds=20), RUB)
    ours, theirs = back_and_forth(tmp_path / "a.sog", source)
    np.testing.assert_allclose(theirs["sh_rest"], ours["sh_rest"], atol=0.03)
    np.testing.assert_allclose(theirs["means"], ours["means"], rtol=1e-3, atol=1e-3)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_gaussforge_reads_the_same(tmp_path: Path) -> None:
    gaussforge = pytest.importorskip("gaussforge")
    from flexgs_edge.io.ply import PlySource

    write_foreign(tmp_path / "a.sog", scene(300, 3, seed=2))
    done = gaussforge.GaussForge().convert((tmp_path / "a.sog").read_bytes(), "sog", "ply")
    (tmp_path / "a.ply").write_bytes(done["data"] if isinstance(done, dict) else done)
    theirs = PlySource(tmp_path / "a.ply").read(slice(0, 300), list(FIELD))
    ours = read_foreign(tmp_path / "a.sog").read(slice(0, 300), list(FIELD))
    for field in ("means", "log_scales", "sh_dc", "sh_rest"):
        np.testing.assert_allclose(theirs[field], ours[field], rtol=1e-4, atol=1e-4, err_msg=field)
    np.testing.assert_allclose(sigmoid(theirs["opacity_logits"]), sigmoid(ours["opacity_logits"]), atol=1e-3)
    np.testing.assert_allclose(np.abs((normalize_quats(theirs["quats"]) * ours["quats"]).sum(axis=0)), 1, atol=1e-4)


def test_too_many_rows() -> None:
    huge = scene(3)
    huge.count = 16380**2 + 1
    with pytest.raises(
        InputError, match="a .sog holds at most 268304400 Gaussians, this scene has 268304401: write a .spz"
    ):
        write_sog(io.BytesIO(), huge, Writing())
