"""Read and write Gaussians as USD (`.usd`, `.usda`, `.usdc`, `.usdz`): prims of type ParticleField3DGaussianSplat.

Source: the schemas of UsdVol in OpenUSD 26.03 and later. Scales are linear, opacities 0 to 1, and each Gaussian has all its SH
coefficients side by side, that of degree 0 first. Every attribute has a second form in half precision, which is read where the
first is missing; else the schema has a default. Prims are moved by their transforms, and stages whose up is z are turned.

usd-core is loaded only for these files. It also reads what a stage refers to, wherever that lies.
"""

import os
import struct
import tempfile
import zipfile
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from flexgs_edge._version import __version__
from flexgs_edge.constants import MAX_SH_DEGREE
from flexgs_edge.errors import FormatError, InputError, brief
from flexgs_edge.io.glb_writer import linear_scales, plain_opacities
from flexgs_edge.io.gltf_container import Packed
from flexgs_edge.io.gltf_splats import AttributeSplats, GltfSource, Move, Splats
from flexgs_edge.io.reading import Reading, Writing
from flexgs_edge.scene.fields import FIELD, sh_rest_count
from flexgs_edge.scene.source import SceneSource

TYPE = "ParticleField3DGaussianSplat"
COEFFICIENTS, DEGREE = "radiance:sphericalHarmonicsCoefficients", "radiance:sphericalHarmonicsDegree"
_SUFFIXES = (".usda", ".usdc", ".usdz", ".usd")
_Y_UP = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])  # From a stage whose up is z
_REACH = 3.0  # Standard deviations of a Gaussian that its stated extent holds
_ZIP_HEADER = 30  # Bytes of a file's header in a zip archive, without its name
_ALIGNED = 64  # Files in a `.usdz` begin at multiples of so many bytes


def read_usd(path: Path, name: str, reading: Reading) -> GltfSource:
    """Open a stage. See `io.formats.Format.reader` for the arguments.

    Raises `InputError` if it shows no Gaussians, and `FormatError` if usd-core cannot read it.
    """
    from pxr import Tf, Usd, UsdGeom

    with tempfile.TemporaryDirectory(prefix="flexgs-") as folder:
        if path.suffix.lower() not in _SUFFIXES:  # usd-core goes by the suffix, which unpacked files lack
            suffix = next((each for each in _SUFFIXES if each in name.lower()), ".usd")
            link = Path(folder) / f"scene{suffix}"
            link.symlink_to(path.resolve())
            path = link
        try:
            stage = Usd.Stage.Open(os.fspath(path))
        except Tf.ErrorException as error:
            why = str(error).replace(os.fspath(path), "it").strip().splitlines()[0].rpartition(" : ")[2]
            raise FormatError(f"{name}: usd-core cannot read it: {brief(why, 200)}; is it complete?") from error
        time = Usd.TimeCode.EarliestTime()
        transforms = UsdGeom.XformCache(time)
        up = _Y_UP if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z else np.eye(4)
        parts: list[tuple[Splats, Move]] = []
        held, others = 0, dict[str, None]()
        for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()):
            image = UsdGeom.Imageable(prim)
            if prim.GetTypeName() != TYPE:
                if prim.IsA(UsdGeom.Gprim):
                    others[str(prim.GetTypeName())] = None
                continue
            if image.ComputeVisibility(time) == UsdGeom.Tokens.invisible:
                continue
            splats, size = _splats(prim, time, f"{name}: {prim.GetPath()}")
            matrix = up @ np.array(transforms.GetLocalToWorldTransform(prim)).T
            if splats.count and matrix[:3, :3].any():
                parts.append((splats, Move(matrix)))
                held += size
    words = ", ".join(list(others)[:8])
    if not parts:
        raise InputError(f"{name}: shows no Gaussians: expected a prim of type {TYPE}, found {words or 'none'}")
    source = GltfSource(name, parts, held)
    source.notes = (f"prims of other types left out: {words}",) if words else ()
    return source


def _splats(prim: Any, time: Any, place: str) -> tuple[AttributeSplats, int]:
    """The Gaussians of a prim, and the bytes of their arrays."""

    def values(word: str, default: tuple[float, ...], rows: int) -> np.ndarray:
        """[rows, width] of an attribute, or of its form in half precision."""
        for attribute in (prim.GetAttribute(word), prim.GetAttribute(word + "h")):
            found = attribute.Get(time) if attribute and attribute.HasAuthoredValue() else None
            if found is not None and len(found) >= max(rows, 1):
                array = np.array(found)
                return array.reshape(len(array), -1)[: rows or None]
        return np.broadcast_to(np.array(default, np.float32), (rows, len(default)))

    means = values("positions", (0, 0, 0), 0)
    count, degree = len(means), int(prim.GetAttribute(DEGREE).Get() or 0)
    if not 0 <= degree <= MAX_SH_DEGREE:
        raise FormatError(f"{place}: {DEGREE}: expected 0 to {MAX_SH_DEGREE}, found {degree}")
    each = 1 + sh_rest_count(degree)
    sh = values(COEFFICIENTS, (0, 0, 0), each * count).reshape(count, each, 3)
    orientations = values("orientations", (0, 0, 0, 1), count)
    scales, opacities = values("scales", (1, 1, 1), count), values("opacities", (1,), count)
    held = sum(array.nbytes for array in (means, orientations, scales, opacities, sh))
    dc, *rest = (Packed(sh[:, number], False) for number in range(each))
    first = [Packed(array, False) for array in (means, orientations, scales, opacities)]
    return AttributeSplats(count, degree, first[0], first[1], first[2], first[3], dc, rest, has_colours=False), held


def _write(suffix: str, file: BinaryIO, source: SceneSource, writing: Writing) -> None:
    """Write a scene. See `io.formats.Format.writer` for the other arguments."""
    from pxr import Gf, Sdf, Usd, UsdGeom, Vt

    planes = source.read(slice(0, source.count), list(FIELD))
    planes["scales"] = linear_scales(planes).astype(np.float32)
    planes["opacities"] = plain_opacities(planes).astype(np.float32)
    rest = planes["sh_rest"].reshape(3, -1, source.count)
    sh = np.concatenate([planes["sh_dc"][:, None], rest], axis=1).transpose(2, 1, 0).reshape(-1, 3)
    around = _REACH * planes["scales"].max(axis=0)
    extent = np.stack([(planes["means"] - around).min(axis=1), (planes["means"] + around).max(axis=1)])
    with tempfile.TemporaryDirectory(prefix="flexgs-") as folder:
        path = Path(folder) / f"scene{'.usdc' if suffix == '.usdz' else suffix}"
        stage = Usd.Stage.CreateNew(os.fspath(path))
        stage.GetRootLayer().documentation = f"flexgs-edge {__version__}"
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        prim = stage.DefinePrim("/Gaussians", TYPE)
        stage.SetDefaultPrim(prim)
        if np.any(source.origin):
            UsdGeom.Xformable(prim).AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(
                Gf.Vec3d(*source.origin.tolist())
            )
        types = Sdf.ValueTypeNames
        for word, type, make, rows in (
            ("positions", types.Point3fArray, Vt.Vec3fArray, planes["means"].T),
            ("orientations", types.QuatfArray, Vt.QuatfArray, planes["quats"][[1, 2, 3, 0]].T),
            ("scales", types.Float3Array, Vt.Vec3fArray, planes["scales"].T),
            ("opacities", types.FloatArray, Vt.FloatArray, planes["opacities"][0]),
            (COEFFICIENTS, types.Float3Array, Vt.Vec3fArray, sh),
            ("extent", types.Float3Array, Vt.Vec3fArray, extent),
        ):
            attribute = prim.CreateAttribute(word, type, False)
            attribute.Set(make.FromNumpy(np.ascontiguousarray(rows, np.float32)))
            if word == COEFFICIENTS:
                attribute.SetMetadata("interpolation", UsdGeom.Tokens.vertex)
                attribute.SetMetadata("elementSize", len(sh) // source.count)
        prim.CreateAttribute(DEGREE, types.Int, False, Sdf.VariabilityUniform).Set(source.sh_degree)
        stage.GetRootLayer().Save()
        del stage, prim, attribute
        data = path.read_bytes()
    if suffix != ".usdz":
        file.write(data)
        return
    # Nothing is packed, and the date is always the same one.
    entry = zipfile.ZipInfo("scene.usdc")
    padding = _ALIGNED - _ZIP_HEADER - len(entry.filename) - 4
    entry.extra = struct.pack("<HH", 0x1986, padding) + bytes(padding)
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr(entry, data)


write_usda, write_usdc, write_usdz, write_usd = (partial(_write, suffix) for suffix in _SUFFIXES)
