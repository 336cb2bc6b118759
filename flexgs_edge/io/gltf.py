"""Read Gaussians from glTF 2.0 (`.glb`, `.gltf`): `KHR_gaussian_splatting`, also compressed as SPZ.

Source: the text of the extension that Khronos ratified in 2026, `extensions/2.0/Khronos/KHR_gaussian_splatting` of
KhronosGroup/glTF. Splats are a POINTS primitive with the attribute POSITION, and under the extension's name ROTATION (x y z w),
SCALE, OPACITY (0 to 1) and SH_DEGREE_d_COEF_n (VEC3, INRIA's order and signs). A node's matrix moves them and turns their SH.

Files of the drafts are read too. What differs:

- Scales are linear since April 2026 and must not be negative; drafts stored logarithms, also as whole numbers with a sign. A
  file stores logarithms if its scales are of a type with a sign, if more than one row in a hundred is negative, or if all
  are zero.
- Without OPACITY or SH_DEGREE_0_COEF_0, the alpha and the colours of COLOR_0 are used, as in 2025's drafts.
- Attributes of 2024 and 2025 begin with `_` in place of the extension's name.
- SH were allowed as normalized bytes and shorts.

SPZ: `KHR_gaussian_splatting_compression_spz_2` (a draft) keeps a `.spz` in a buffer view. Its text wants the values unpacked
to left-up-front, glTF's axes, from SPZ's own right-up-back; cesium-native does so. CesiumJS and some writers take them as
they are. POSITION states its least and largest values, so that a file can tell: if these fit better without the turn (of half a
circle about y), the values are taken as they are.
"""

from pathlib import Path

import numpy as np

from flexgs_edge.errors import FormatError, InputError, brief
from flexgs_edge.io.frames import LUF, RUB, in_frame
from flexgs_edge.io.gltf_container import GltfFile, Packed
from flexgs_edge.io.gltf_splats import AttributeSplats, GltfSource, Move, Splats, SpzSplats, shown_meshes
from flexgs_edge.io.json_object import JsonObject
from flexgs_edge.io.reading import Reading
from flexgs_edge.scene.source import SceneSource

EXTENSION = "KHR_gaussian_splatting"
SPZ_EXTENSIONS = (
    "KHR_gaussian_splatting_compression_spz_2",
    "KHR_gaussian_splatting_compression_spz",
    "KHR_spz_gaussian_splats_compression",
)  # Names of the extension that keeps a `.spz`; the last one is that of 2025, on the primitive itself
_KNOWN = (EXTENSION, *SPZ_EXTENSIONS, "KHR_mesh_quantization")
_HARMLESS = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_")
"""Beginnings of extensions that do not concern splats."""
_INSTANCES = "EXT_mesh_gpu_instancing"
_EXPECTED = {"kernel": "ellipse", "projection": "perspective", "sortingMethod": "cameraDistance"}
_DEGREES = 3
_NEGATIVE_SHARE = 0.01
_ROWS_PER_BYTE = 16
"""Most Gaussians that a byte of the file may stand for: nodes can show one mesh many times, but not without end."""
_MOST_PARTS = 1 << 12  # Most times that splats are shown: each read goes over all of them
_SHOWN = 16  # Most notes of a scene, and extensions in a message


def read_gltf(path: Path, name: str, reading: Reading) -> GltfSource:
    """Open a `.glb` or `.gltf`. See `io.formats.Format.reader` for the arguments.

    Raises `InputError` if it shows no Gaussians, or needs an extension that we do not know. Raises `FormatError` if it
    is damaged.
    """
    file = GltfFile(path, name)
    unknown = [
        word for word in file.json.texts("extensionsRequired") if word not in _KNOWN and not word.startswith(_HARMLESS)
    ]
    if unknown:
        words = ", ".join(brief(word) for word in unknown[:_SHOWN]) + (", ..." if len(unknown) > _SHOWN else "")
        raise InputError(
            f"{name}: needs extensions that we do not know: {words}; convert it with a program that knows them"
        )
    return _Reader(file).scene()


class _Reader:
    """Collects the splats of a file."""

    def __init__(self, file: GltfFile) -> None:
        self.file, self.json = file, file.json
        self.notes: dict[str, None] = dict.fromkeys(file.notes)  # in order, each of them once
        self.spz: list[SceneSource] = []
        self.attributes: list[AttributeSplats] = []
        self.left_out = 0

    def scene(self) -> GltfSource:
        meshes: dict[int, list[Splats]] = {}
        parts: list[tuple[Splats, Move]] = []
        rows = 0
        for shown in shown_meshes(self.json):
            if shown.mesh not in meshes:
                meshes[shown.mesh] = self._mesh(shown.mesh, f"nodes[{shown.node}]")
            splats = meshes[shown.mesh]
            if not splats:
                continue
            self._check_node(shown.node)
            if not shown.matrix[:3, :3].any():
                self.notes["nodes scaled to nothing left out"] = None
                continue
            move = Move(shown.matrix)
            parts += [(part, move) for part in splats]
            self._check_parts(len(parts))
            rows += sum(part.count for part in splats)
            held = self.file.size + sum(source.held_bytes for source in self.spz)
            if rows > _ROWS_PER_BYTE * held:
                raise FormatError(f"{self.file.name}: shows more than {rows - 1} Gaussians, but has {held} bytes")
        if not (self.spz or self.attributes):
            raise InputError(f"{self.file.name}: {self._what_it_is()}")
        self._settle_scales()
        if self.left_out:
            self.notes[f"{self.left_out} meshes or point clouds that are no splats left out"] = None
        if self.json.items("animations"):
            self.notes["animations left out"] = None
        held = self.file.held_bytes + sum(source.held_bytes for source in self.spz)
        source = GltfSource(self.file.name, parts, held)
        more = len(self.notes) - _SHOWN
        source.notes = (*list(self.notes)[:_SHOWN], *((f"{more} further notes left out",) if more > 0 else ()))
        source.file_bytes = self.file.size
        marks = [bool(source.settings.get("antialiased")) for source in self.spz]
        if marks and all(marks) and not self.attributes:
            source.settings = {"antialiased": True}
        elif any(marks):
            source.notes += ("some parts say that they are antialiased: use --antialiased to draw all of them so",)
        return source

    def _what_it_is(self) -> str:
        kinds = {"a mesh": 0, "a point cloud": 0}
        for index in range(len(self.json.items("meshes"))):
            for primitive in self._primitives(index, "meshes"):
                if EXTENSION in primitive.inner("extensions") or _spz_record(primitive) is not None:
                    return "its splats are in no node of the scene that it shows; expected one that shows them"
                kinds["a point cloud" if primitive.whole("mode", 4) == 0 else "a mesh"] += 1
        found = " and ".join(kind for kind, count in kinds.items() if count) or "a glTF without meshes"
        return f"holds {found}, not Gaussians: expected a primitive with {EXTENSION}"

    def _primitives(self, mesh: int, asker: str) -> list[JsonObject]:
        record = self.json.item("meshes", mesh, asker)
        values = record.items("primitives")
        return [JsonObject(record.name, value, f"{record.place}.primitives[{i}]") for i, value in enumerate(values)]

    def _mesh(self, mesh: int, asker: str) -> list[Splats]:
        """The splats of a mesh, without empty ones."""
        found: list[Splats] = []
        for primitive in self._primitives(mesh, asker):
            spz = _spz_record(primitive)
            if spz is None and EXTENSION not in primitive.inner("extensions"):
                self.left_out += 1
                continue
            self._note_differences(primitive)
            splats: Splats = self._spz(primitive, spz) if spz is not None else self._attributes(primitive)
            if splats.count:
                found.append(splats)
                self._check_parts(len(found))
        return found

    def _check_parts(self, parts: int) -> None:
        if parts > _MOST_PARTS:
            raise FormatError(
                f"{self.file.name}: expected splats that are shown at most {_MOST_PARTS} times, in all meshes and nodes, "
                "found more; join them"
            )

    def _check_node(self, index: int) -> None:
        node = self.json.item("nodes", index, "nodes")
        if _INSTANCES in node.inner("extensions"):
            raise InputError(
                f"{self.file.name}: {node.place}: {_INSTANCES} shows splats many times, which we do not read; "
                "convert it with a program that does"
            )
        if "skin" in node:
            self.notes["skins left out"] = None

    def _note_differences(self, primitive: JsonObject) -> None:
        """Note what we would draw in another way."""
        if primitive.whole("mode", 4) != 0:
            self.notes["splats whose mode is not POINTS are read as points"] = None
        if "indices" in primitive:
            self.notes["indices of splats ignored"] = None
        record = primitive.inner("extensions").inner(EXTENSION)
        for key, expected in _EXPECTED.items():
            found = record.text(key, expected)
            if found != expected:
                self.notes[f"{key} {brief(found, 40)} is drawn as {expected}"] = None
        space = record.text("colorSpace", "srgb_rec709_display")
        if space not in ("srgb_rec709_display", "BT.709"):
            self.notes[f"colours in {brief(space, 40)} are kept as they are, and drawn as sRGB"] = None
        for word in record.inner("extensions").value:
            if word not in SPZ_EXTENSIONS:
                self.notes[f"extension {brief(word, 60)} ignored"] = None

    def _attributes(self, primitive: JsonObject) -> AttributeSplats:
        attributes = _Attributes(self.file, primitive)
        means = attributes.get("POSITION", 3)
        dc = attributes.find(_coefficient(0, 0), (3,))
        opacities = attributes.find("OPACITY", (1,))
        has_colours = dc is None
        if dc is None:
            dc = self._colours(attributes, _coefficient(0, 0), (3, 4))
        if opacities is None:
            opacities = self._colours(attributes, "OPACITY", (4,))
        rest: list[Packed] = []
        degree = 0
        while degree < _DEGREES:
            band = [attributes.find(_coefficient(degree + 1, n), (3,)) for n in range(2 * degree + 3)]
            if any(packed is None for packed in band):
                break
            rest += [packed for packed in band if packed is not None]
            degree += 1
        if len(rest) < sum("SH_DEGREE_" in key and "SH_DEGREE_0" not in key for key in attributes.record.value):
            self.notes[f"SH above degree {degree} left out: they are incomplete, or of a degree above {_DEGREES}"] = (
                None
            )
        splats = AttributeSplats(
            len(means.values), degree, means, attributes.get("ROTATION", 4), attributes.get("SCALE", 3), opacities, dc, rest,
            has_colours,
        )  # fmt: skip
        self.attributes.append(splats)
        return splats

    def _colours(self, attributes: "_Attributes", missing: str, widths: tuple[int, ...]) -> Packed:
        """COLOR_0, in place of an attribute that is missing."""
        colours = attributes.find("COLOR_0", widths)
        if colours is None:
            raise attributes.missing(missing)
        self.notes[f"{missing} is missing: COLOR_0 taken in its place"] = None
        return colours

    def _settle_scales(self) -> None:
        """Decide for the whole file whether scales are logarithms."""
        scales = {id(splats.scales): splats.scales.values for splats in self.attributes if splats.count}.values()
        if not scales:
            return
        with np.errstate(invalid="ignore"):
            negative = sum(int(np.count_nonzero((values < 0).any(axis=1))) for values in scales)
            flat = all(bool((values == 0).all()) for values in scales)
        signed = any(values.dtype.kind == "i" for values in scales)
        if signed or flat or negative > _NEGATIVE_SHARE * sum(len(values) for values in scales):
            self.notes["scales are logarithms, as in drafts of the extension"] = None
            for splats in self.attributes:
                splats.as_logs = True

    def _spz(self, primitive: JsonObject, record: JsonObject) -> SpzSplats:
        # Imported only for these files, so that the others start faster.
        from flexgs_edge.io.spz import spz_source

        index = record.whole("bufferView")
        data = self.file.view(index, record.place).tobytes()
        source = spz_source(data, f"{self.file.name}: {primitive.place}: the .spz in bufferViews[{index}]")
        self.spz.append(source)
        self.notes |= dict.fromkeys(source.notes)
        if not source.count:
            return SpzSplats(source)
        turned = in_frame(in_frame(source, source.frame or RUB), LUF)
        bounds = self._stated_bounds(primitive)
        if bounds is not None and source.frame is None:
            means = np.concatenate([source.read(rows, ["means"])["means"] for rows in source.chunks(65536)], axis=1)
            own = np.stack([means.min(axis=1), means.max(axis=1)]).astype(np.float64)
            other = np.stack([own[::-1, 0] * -1, own[:, 1], own[::-1, 2] * -1], axis=1)
            with np.errstate(over="ignore", invalid="ignore"):
                if np.abs(own - bounds).sum() < np.abs(other - bounds).sum():
                    return SpzSplats(source)
        return SpzSplats(turned)

    def _stated_bounds(self, primitive: JsonObject) -> np.ndarray | None:
        """[2, 3] f64, the least and the largest position that the file states, if it does."""
        attributes = primitive.inner("attributes")
        if "POSITION" not in attributes:
            return None
        record = self.json.item("accessors", attributes.whole("POSITION"), attributes.place)
        if "min" not in record or "max" not in record:
            return None
        return np.stack([record.numbers("min", 3), record.numbers("max", 3)])


class _Attributes:
    """Attributes of a primitive, by their names without the extension's."""

    def __init__(self, file: GltfFile, primitive: JsonObject) -> None:
        self.file, self.record = file, primitive.inner("attributes")
        self.count: int | None = None

    def find(self, word: str, widths: tuple[int, ...]) -> Packed | None:
        """The values of an attribute if it is there."""
        names = (word,) if word in ("POSITION", "COLOR_0") else (f"{EXTENSION}:{word}", f"_{word}")
        key = next((name for name in names if name in self.record), None)
        if key is None:
            return None
        packed = self.file.accessor(self.record.whole(key), f"{self.record.place}.{key}")
        count, width = packed.values.shape
        if width not in widths:
            raise self.record.fail(key, f"numbers in {' or '.join(map(str, widths))} columns", width)
        self.count = count if self.count is None else self.count
        if count != self.count:
            raise self.record.fail(key, f"as many rows as POSITION has, {self.count}", count)
        return packed

    def get(self, word: str, width: int) -> Packed:
        """The values of an attribute that must be there."""
        packed = self.find(word, (width,))
        if packed is None:
            raise self.missing(word)
        return packed

    def missing(self, word: str) -> FormatError:
        """The error for an attribute that is not there."""
        found = ", ".join(brief(key, 50) for key in list(self.record.value)[:8]) or "none"
        return FormatError(f"{self.file.name}: {self.record.place}: missing {word}; found {found}")


def _coefficient(degree: int, number: int) -> str:
    return f"SH_DEGREE_{degree}_COEF_{number}"


def _spz_record(primitive: JsonObject) -> JsonObject | None:
    """The object that names a primitive's `.spz`, if it has one."""
    outer = primitive.inner("extensions")
    for word in SPZ_EXTENSIONS:
        for place in (outer.inner(EXTENSION).inner("extensions"), outer):
            if word in place:
                return place.inner(word)
    return None
