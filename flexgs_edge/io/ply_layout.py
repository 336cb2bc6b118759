"""Parse PLY headers, and check their claims against the size of the file before anything is allocated."""

from dataclasses import dataclass, field
from typing import BinaryIO

import numpy as np

from flexgs_edge.constants import MAX_SH_DEGREE
from flexgs_edge.errors import FormatError, brief
from flexgs_edge.scene.fields import FIELD, FIELDS, sh_rest_count
from flexgs_edge.scene.source import REST_WIDTHS

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_NAMES = {kind: name for name, kind in reversed(_TYPES.items())}
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_HEADER_LIMIT = 1 << 20
_MOST_LINES = 1 << 13
"""Most bytes and lines of a header; those of scenes have 2 kB in a hundred lines. What comes later is not looked at."""
_SILENT = ("nx", "ny", "nz")  # Properties of INRIA's layout without content (normals)
RGB = ("red", "green", "blue")
"""8-bit colours, which nerfstudio's export has in place of `f_dc` with `--ply-color-mode rgb`."""
_SHOWN = 8  # Most names in a message
_LIST_BYTES = 200  # Memory that plyfile takes for a list of a row, beside the values
PROGRAM = "flexgs-edge"  # First word of our comments
SMOOTHING = "filter_3D"
"""Property of Mip-Splatting: standard deviation (scene units) of a filter that stored scales and opacities do not include."""


@dataclass
class Property:
    """One property of an element; `length` is the type of a list's count, and None for scalars."""

    name: str
    type: str
    length: str | None = None

    @property
    def smallest(self) -> int:
        """Least bytes of one value in a binary file."""
        return np.dtype(self.length or self.type).itemsize


@dataclass
class Element:
    """One element of the header, such as `vertex`."""

    name: str
    count: int
    properties: list[Property] = field(default_factory=list)

    @property
    def scalar(self) -> bool:
        """Whether the element has no lists, so that all its rows have one size."""
        return all(p.length is None for p in self.properties)

    @property
    def row_size(self) -> int:
        """Bytes of a row in a binary file; with lists, the least."""
        return sum(p.smallest for p in self.properties)


@dataclass
class PlyHeader:
    """A parsed header."""

    name: str  # the user's path, for messages
    order: str  # byte order, "<" or ">"; "" for ascii
    elements: list[Element]  # in the order of the file
    data_offset: int  # first byte of the data
    comments: tuple[str, ...] = ()  # comments that this program wrote
    antialiased: bool | None = None  # what a comment of Brush or Postshot says; `None` without one

    @property
    def vertex(self) -> Element:
        """The element with the Gaussians; raises `FormatError` if there is none."""
        for element in self.elements:
            if element.name == "vertex":
                return element
        names = _list([element.name for element in self.elements]) or "none"
        raise FormatError(f"{self.name}: no element 'vertex'; found {names}")

    @property
    def before(self) -> list[Element]:
        """The elements stored before `vertex`."""
        return self.elements[: self.elements.index(self.vertex)]

    @property
    def plain(self) -> bool:
        """Whether rows can be read by range: a binary file, with no lists in `vertex` or before it."""
        return bool(self.order) and all(element.scalar for element in (*self.before, self.vertex))

    @property
    def text(self) -> str:
        """The header as text, without comments."""
        names = {order: name for name, order in _FORMATS.items()}
        lines = ["ply", f"format {names[self.order]} 1.0"]
        for element in self.elements:
            lines.append(f"element {element.name} {element.count}")
            for p in element.properties:
                kind = _NAMES[p.type] if p.length is None else f"list {_NAMES[p.length]} {_NAMES[p.type]}"
                lines.append(f"property {kind} {p.name}")
        return "\n".join([*lines, "end_header", ""])

    def dtype(self, element: Element) -> np.dtype:
        """One row of an element without lists, in a binary file."""
        return np.dtype([(p.name, self.order + p.type) for p in element.properties])

    def whole_bytes(self, size: int) -> int:
        """About how many bytes plyfile takes to read a file of `size` bytes as a whole."""
        listed = sum(e.count * sum(p.length is not None for p in e.properties) for e in self.elements)
        scalar = sum(e.count * e.row_size for e in self.elements)
        return size + 2 * scalar + _LIST_BYTES * listed

    def check_size(self, size: int) -> int:
        """Compare the claims of the header with the file's `size` in bytes (exactly for binary files without lists).

        Returns bytes behind the data; 0 where lists or text leave them unknown. Raises `FormatError` if data are missing.
        """
        for element in self.elements:
            if element.count and not element.properties:
                raise FormatError(
                    f"{self.name}: element {brief(element.name)} has {element.count} rows without properties"
                )
        # In ascii, a value takes at least one character and a separator; the last value may lack the separator.
        exact = bool(self.order) and all(element.scalar for element in self.elements)
        least = sum(e.count * (e.row_size if self.order else 2 * len(e.properties)) for e in self.elements)
        found = size - self.data_offset
        claims = _list([f"{e.count} x {e.name}" for e in self.elements])
        if found + (not self.order) < least:
            promised = f"{'' if exact else 'at least '}{least} bytes"
            raise FormatError(
                f"{self.name}: truncated: the header promises {claims}, {promised} from byte {self.data_offset}; "
                f"found {found}"
            )
        return found - least if exact else 0


def read_header(name: str, file: BinaryIO) -> PlyHeader:
    """Parse the header of the PLY `file`, which must be at its start; messages call it `name`.

    Raises `FormatError` if the header breaks the format; the message names the line and what was expected there.
    """
    number, order, elements, comments, antialiased = 0, None, list[Element](), list[str](), None
    names: set[tuple[str, ...]] = set()
    while True:
        number += 1
        raw = file.readline(_HEADER_LIMIT + 1 - min(file.tell(), _HEADER_LIMIT))
        words = raw.decode("ascii", "replace").split()
        place = f"{name}: header line {number}"
        if number == 1:
            if raw.rstrip(b"\r\n") != b"ply":
                raise FormatError(f"{name}: not a PLY file: expected 'ply' in the first line, found {raw[:16]!r}")
        elif not raw.endswith(b"\n") or number > _MOST_LINES:
            looked = f"{file.tell()} bytes, {number} lines"
            raise FormatError(f"{name}: the header has no 'end_header' line (looked at {looked})")
        elif words[:1] == ["end_header"]:
            break
        elif words[:1] == ["format"]:
            order = _format(place, words, order)
        elif words[:1] == ["element"]:
            elements.append(_element(place, words, names))
        elif words[:1] == ["property"]:
            if not elements:
                raise FormatError(f"{place}: a property before any element")
            elements[-1].properties.append(_property(place, words, elements[-1].name, names))
        elif words[:2] == ["comment", PROGRAM]:
            comments.append(" ".join(words[1:]))
        elif words[:1] == ["comment"]:
            said = _antialiased(words[1:])
            antialiased = antialiased if said is None else said
        elif words and words[0] != "obj_info":
            found = brief(words[0])
            raise FormatError(f"{place}: expected format, element, property, comment or end_header, found {found}")
    if order is None:
        raise FormatError(f"{name}: the header has no 'format' line; expected one of {', '.join(_FORMATS)}")
    return PlyHeader(name, order, elements, file.tell(), tuple(comments), antialiased)


def _antialiased(words: list[str]) -> bool | None:
    """Whether a comment says that the model is antialiased; `None` if it says neither. Upper and lower case are the same.

    Brush writes `SplatRenderMode: mip` or `default`, Postshot `antialiased 1` or `0`. The last such comment holds.
    """
    known = {
        ("splatrendermode:", "mip"): True,
        ("splatrendermode:", "default"): False,
        ("antialiased", "1"): True,
        ("antialiased", "0"): False,
    }
    return known.get((words[0].lower(), words[1].lower())) if len(words) == 2 else None


def _format(place: str, words: list[str], order: str | None) -> str:
    if order is not None:
        raise FormatError(f"{place}: a second 'format' line")
    if len(words) != 3 or words[1] not in _FORMATS or words[2] != "1.0":
        raise FormatError(
            f"{place}: expected 'format' and one of {', '.join(_FORMATS)}, 1.0; found {' '.join(words)[:80]!r}"
        )
    return _FORMATS[words[1]]


def _element(place: str, words: list[str], names: set[tuple[str, ...]]) -> Element:
    if len(words) != 3 or not (words[2].isascii() and words[2].isdigit()) or len(words[2]) > 18:
        raise FormatError(f"{place}: expected 'element NAME COUNT', found {' '.join(words)[:80]!r}")
    _add(names, (words[1],), f"{place}: a second element {brief(words[1])}")
    return Element(words[1], int(words[2]))


def _property(place: str, words: list[str], element: str, names: set[tuple[str, ...]]) -> Property:
    types = words[2:4] if words[1:2] == ["list"] else words[1:2]
    if len(words) != len(types) + (3 if words[1:2] == ["list"] else 2):
        raise FormatError(f"{place}: expected 'property TYPE NAME', found {' '.join(words)[:80]!r}")
    for name in types:
        if name not in _TYPES:
            raise FormatError(f"{place}: unknown type {brief(name)}; expected one of {', '.join(_TYPES)}")
    _add(names, (element, words[-1]), f"{place}: a second property {brief(words[-1])} in element {brief(element)}")
    if len(types) == 2:
        if _TYPES[types[0]].startswith("f"):
            raise FormatError(f"{place}: a list's length has type {types[0]!r}; expected an integer type")
        return Property(words[-1], _TYPES[types[1]], _TYPES[types[0]])
    return Property(words[-1], _TYPES[types[0]])


def _add(names: set[tuple[str, ...]], name: tuple[str, ...], twice: str) -> None:
    if name in names:
        raise FormatError(twice)
    names.add(name)


def gaussian_layout(header: PlyHeader) -> tuple[int, tuple[str, ...]]:
    """SH degree of the scene, and notes on properties that are left out.

    Raises `FormatError` if properties are missing or of the wrong type, or the number of `f_rest_*` is wrong.
    """
    vertex = header.vertex
    by_name = {p.name: p for p in vertex.properties}
    degree = _sh_degree(header.name, by_name)
    colours = colour_names(header)
    needed = [name for f in FIELDS for name in (colours if f.name == "sh_dc" else f.ply_names(degree))]
    missing = [name for name in needed if name not in by_name]
    if missing:
        raise FormatError(f"{header.name}: element 'vertex' lacks the properties {_list(missing)}")
    numbers = [name for name in needed if name not in RGB]
    wrong = [name for name in numbers if by_name[name].length or not by_name[name].type.startswith("f")]
    if wrong:
        kind = "a list" if by_name[wrong[0]].length else f"type {by_name[wrong[0]].type}"
        raise FormatError(f"{header.name}: property {wrong[0]!r} is {kind}; expected float or double")
    smoothed = smoothing_of(header)
    known = {*needed, *_SILENT, *((SMOOTHING,) if smoothed else ())}
    extra = [name for name in by_name if name not in known]
    notes = [f"extra properties left out: {_list(extra)}"] if extra else []
    if colours == RGB:
        notes.append("colours read from red, green, blue (8 bits each), as the file has no f_dc")
    if smoothed:
        notes.append(
            f"{SMOOTHING} applied to scales and opacities (Mip-Splatting; it dilates by 0.1 px^2, here it is 0.3)"
        )
    return degree, (*notes, *left_out([element for element in header.elements if element is not vertex]))


def left_out(elements: list[Element]) -> list[str]:
    """Notes on elements that are not read."""
    notes = [f"element {brief(element.name)} left out ({element.count} rows)" for element in elements[:_SHOWN]]
    return notes + ([f"{len(elements) - _SHOWN} further elements left out"] if len(elements) > _SHOWN else [])


def colour_names(header: PlyHeader) -> tuple[str, ...]:
    """The properties that hold the colours of Gaussians: `f_dc_*`, or `RGB` of a file that has only these."""
    scalars = {p.name: p.type for p in header.vertex.properties if p.length is None}
    bytes_only = "opacity" in scalars and "f_dc_0" not in scalars and all(scalars.get(name) == "u1" for name in RGB)
    return RGB if bytes_only else FIELD["sh_dc"].ply


def smoothing_of(header: PlyHeader) -> bool:
    """Whether the vertices have a 3D filter of Mip-Splatting that must still be applied."""
    return any(p.name == SMOOTHING and p.length is None and p.type.startswith("f") for p in header.vertex.properties)


def _sh_degree(name: str, by_name: dict[str, Property]) -> int:
    found = sum(each.startswith("f_rest_") for each in by_name)
    if found not in REST_WIDTHS:
        expected = ", ".join(f"{3 * sh_rest_count(d)} (degree {d})" for d in range(MAX_SH_DEGREE + 1))
        raise FormatError(f"{name}: {found} properties f_rest_*; expected {expected}")
    return REST_WIDTHS[found]


def _list(names: list[str]) -> str:
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(name[:80] for name in names[:_SHOWN]) + more
