"""USD: what usd-core reads of our files, and what we read of stages that it writes."""

from __future__ import annotations

import gzip
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexgs_edge.commands.decompress import decompress
from flexgs_edge.errors import FormatError, InputError
from flexgs_edge.io.exchange import near_order, write_foreign
from flexgs_edge.io.ply import write_ply
from flexgs_edge.io.usd import COEFFICIENTS, DEGREE, TYPE
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.rotations import normalize_quats
from flexgs_edge.scene.source import MemorySource, Planes
from scene_files import open_scene
from synthetic import random_scene

SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
COUNT = 60


@pytest.fixture(scope="session")
def pxr() -> Any:
    return pytest.importorskip("pxr", reason="no usd-core here: pip install flexgs-edge[usd]")


def expected(source: MemorySource) -> Planes:
    """The scene's values in the order of the files, and unit quaternions."""
    planes = source.select(near_order(source)).read(slice(0, source.count), list(FIELD))
    planes["quats"] = normalize_quats(planes["quats"])
    return planes


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("degree", [0, 3])
def test_round_trips(pxr: Any, tmp_path: Path, suffix: str, degree: int) -> None:
    source = MemorySource(random_scene(COUNT, degree=degree).read(slice(0, COUNT), list(FIELD)))
    path = tmp_path / f"a{suffix}"
    assert write_foreign(path, source) == ()
    back = open_scene(path)
    assert (back.count, back.sh_degree, back.notes) == (COUNT, degree, ())
    ours, theirs = expected(source), back.read(slice(0, COUNT), list(FIELD))
    for name in ("means", "sh_dc", "sh_rest", "quats"):
        np.testing.assert_array_equal(theirs[name], ours[name], err_msg=name)
    np.testing.assert_allclose(theirs["log_scales"], ours["log_scales"], atol=2e-7)
    np.testing.assert_allclose(theirs["opacity_logits"], ours["opacity_logits"], atol=5e-5)
    first = path.read_bytes()
    write_foreign(path, source, force=True)
    assert path.read_bytes() == first


def test_a_second_trip_changes_nothing(pxr: Any, tmp_path: Path) -> None:
    """Scales and opacities change their form: what float32 has of them stays."""
    write_foreign(tmp_path / "a.usdc", random_scene(COUNT, degree=1))
    first = open_scene(tmp_path / "a.usdc")
    write_foreign(tmp_path / "b.usdc", MemorySource(first.read(slice(0, COUNT), list(FIELD))))
    a, b = (stage_values(pxr, tmp_path / name) for name in ("a.usdc", "b.usdc"))
    for name in a:
        np.testing.assert_allclose(b[name], a[name], rtol=3e-7, err_msg=name)


def stage_values(pxr: Any, path: Path) -> dict[str, np.ndarray]:
    """What usd-core reads by its own classes of the schema."""
    from pxr import Usd, UsdVol

    stage = Usd.Stage.Open(str(path))
    splat = UsdVol.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
    assert splat.GetPrim().GetTypeName() == TYPE
    return {
        "positions": np.array(splat.GetPositionsAttr().Get()),
        "orientations": np.array(splat.GetOrientationsAttr().Get()),
        "scales": np.array(splat.GetScalesAttr().Get()),
        "opacities": np.array(splat.GetOpacitiesAttr().Get()),
        "sh": np.array(splat.GetRadianceSphericalHarmonicsCoefficientsAttr().Get()),
        "degree": np.array(splat.GetRadianceSphericalHarmonicsDegreeAttr().Get()),
        "extent": np.array(splat.GetExtentAttr().Get()),
    }


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_usd_core_reads_the_same_values(pxr: Any, tmp_path: Path, suffix: str) -> None:
    source = random_scene(COUNT, degree=2)
    write_foreign(tmp_path / f"a{suffix}", source)
    found, ours = stage_values(pxr, tmp_path / f"a{suffix}"), expected(source)
    turn = np.array([1, -1, -1], np.float32)
    np.testing.assert_array_equal(found["positions"], ours["means"].T * turn)
    np.testing.assert_array_equal(found["orientations"][:, [3, 0, 1, 2]], ours["quats"].T * np.array([1, *turn]))
    np.testing.assert_allclose(found["scales"], np.exp(ours["log_scales"].T), rtol=2e-7)
    np.testing.assert_allclose(found["opacities"], 1 / (1 + np.exp(-ours["opacity_logits"][0])), rtol=2e-7)
    assert found["degree"] == 2 and found["sh"].shape == (9 * COUNT, 3)
    np.testing.assert_array_equal(found["sh"][::9], ours["sh_dc"].T)
    # Of y, z and x, the first two change their signs; of the functions of degree 2, xy and xz do.
    signs = np.array([-1, -1, 1, -1, 1, 1, -1, 1])
    rest = ours["sh_rest"].reshape(3, 8, COUNT) * signs[:, None]
    np.testing.assert_array_equal(found["sh"].reshape(COUNT, 9, 3)[:, 1:], rest.transpose(2, 1, 0))
    assert (found["extent"][0] < found["positions"].min(axis=0)).all()
    assert (found["extent"][1] > found["positions"].max(axis=0)).all()


def test_usdz_is_a_plain_zip_with_aligned_files(pxr: Any, tmp_path: Path) -> None:
    write_foreign(tmp_path / "a.usdz", random_scene(5))
    with zipfile.ZipFile(tmp_path / "a.usdz") as archive:
        (entry,) = archive.infolist()
        data = archive.read(entry)
    assert (
        entry.compress_type == zipfile.ZIP_STORED
        and (tmp_path / "a.usdz").read_bytes()[64:72] == data[:8] == b"PXR-USDC"
    )


def test_stages_of_others(pxr: Any, tmp_path: Path) -> None:
    """Half precision, defaults, transforms, an invisible prim, a stage whose up is z."""
    path = tmp_path / "a.usda"
    path.write_text(f"""#usda 1.0
(
    upAxis = "Z"
)
def Xform "moved"
{{
    double3 xformOp:translate = (500000, 0, 8)
    float3 xformOp:scale = (2, 2, 2)
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
    def {TYPE} "one"
    {{
        point3h[] positionsh = [(1, 2, 3), (0.5, 0, 0)]
        half3[] scalesh = [(1, 1, 1), (0.25, 1, 1)]
        half[] opacitiesh = [0.5, 0.75]
        uniform int {DEGREE} = 0
        half3[] {COEFFICIENTS}h = [(1, 0, 0), (0, 1, 0)]
    }}
    def {TYPE} "plain"
    {{
        point3f[] positions = [(0, 0, 0)]
    }}
    def {TYPE} "hidden"
    {{
        token visibility = "invisible"
        point3f[] positions = [(9, 9, 9)]
    }}
    def Cube "box"
    {{
    }}
}}
""")
    source = open_scene(path)
    planes = source.read(slice(0, source.count), list(FIELD))
    assert source.count == 3 and source.sh_degree == 3 and source.notes == ("prims of other types left out: Cube",)
    # x stays; up, z, is -y here; y, which then points away from the eye, is z here.
    world = planes["means"] + source.origin[:, None]
    np.testing.assert_allclose(world.T, [[500002, -14, 4], [500001, -8, 0], [500000, -8, 0]])
    np.testing.assert_allclose(planes["sh_dc"].T, [[1, 0, 0], [0, 1, 0], [0, 0, 0]])
    np.testing.assert_allclose(np.exp(planes["log_scales"][0]), [2, 0.5, 2], rtol=1e-6)
    np.testing.assert_allclose(planes["opacity_logits"][0], [0, np.log(3), np.inf], rtol=1e-6)


def test_far_scenes_keep_their_places(pxr: Any, tmp_path: Path) -> None:
    planes = random_scene(COUNT).read(slice(0, COUNT), list(FIELD))
    source = MemorySource(planes, origin=np.array([5e5, 4e6, 0]))
    write_foreign(tmp_path / "a.usdz", source)
    back = open_scene(tmp_path / "a.usdz")
    means = back.read(slice(0, COUNT), ["means"])["means"] + (back.origin - source.origin)[:, None]
    np.testing.assert_allclose(means, expected(source)["means"], atol=1e-6)


def test_packed_files_and_wrong_names(pxr: Any, tmp_path: Path) -> None:
    write_foreign(tmp_path / "a.usdc", random_scene(5))
    data = (tmp_path / "a.usdc").read_bytes()
    (tmp_path / "a.usdc.gz").write_bytes(gzip.compress(data))
    assert open_scene(tmp_path / "a.usdc.gz").count == 5
    (tmp_path / "a.glb").write_bytes(data)
    with pytest.raises(FormatError, match="this is a USD file: rename it to a.usdc"):
        open_scene(tmp_path / "a.glb")
    (tmp_path / "b.usdc").write_bytes(data[:100])
    with pytest.raises(FormatError, match=r"b.usdc: usd-core cannot read it: .*is it complete\?"):
        open_scene(tmp_path / "b.usdc")
    (tmp_path / "c.usda").write_text('#usda 1.0\ndef Mesh "a"\n{\n}\n')
    with pytest.raises(InputError, match=f"expected a prim of type {TYPE}, found Mesh"):
        open_scene(tmp_path / "c.usda")
    (tmp_path / "d.usda").write_text(f'#usda 1.0\ndef {TYPE} "a"\n{{\nuniform int {DEGREE} = 9\n}}\n')
    with pytest.raises(FormatError, match=f"{DEGREE}: expected 0 to 4, found 9"):
        open_scene(tmp_path / "d.usda")


def test_without_usd_core_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flexgs_edge.io.formats.find_spec", lambda name: None)
    write_ply(tmp_path / "a.ply", random_scene(5))
    with pytest.raises(InputError, match=r"\.usdz files need pip install 'flexgs-edge\[usd\]'"):
        decompress(tmp_path / "a.ply", tmp_path / "a.usdz")
    (tmp_path / "a.usda").write_text("#usda 1.0\n")
    with pytest.raises(InputError, match=r"\.usda files need pip install"):
        open_scene(tmp_path / "a.usda")
