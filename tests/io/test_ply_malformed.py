"""PLY files that break their format: each is a clear error that names what is wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flexgs_edge.errors import FlexGSError, FormatError, InputError
from flexgs_edge.io.ply import PlySource
from flexgs_edge.scene.check import check_scene
from flexgs_edge.scene.fields import FIELD
from scene_files import edit, header, property_names, random_rows, write_rows

GOOD = random_rows(5, 1)
TEXT = header(GOOD)
DATA = GOOD.tobytes()
FACES = "element face 2\nproperty list uchar int vertex_indices"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("ply\n", "plx\n", "not a PLY file: expected 'ply' in the first line, found b'plx"),
        ("format binary_little_endian 1.0\n", "", "no 'format' line; expected one of ascii, binary_little"),
        ("1.0", "2.0", r"header line 2: expected 'format' and one of .* found 'format binary_little_endian 2.0'"),
        ("binary_little_endian", "binary_middle_endian", "header line 2"),
        ("format", "format ascii 1.0\nformat", "header line 3: a second 'format' line"),
        ("element vertex 5", "element vertex", "header line 3: expected 'element NAME COUNT'"),
        ("element vertex 5", "element vertex -5", "expected 'element NAME COUNT', found 'element vertex -5'"),
        ("element vertex 5", "element vertex 5.0", "expected 'element NAME COUNT'"),
        ("element vertex 5", "element vertex " + "9" * 30, "expected 'element NAME COUNT'"),
        ("element vertex 5", "element vertex 5\nelement vertex 5", "a second element 'vertex'"),
        ("element vertex 5", "element points 5", "no element 'vertex'; found points"),
        ("element vertex 5\n", "", "header line 3: a property before any element"),
        ("element vertex 5", "element none 3\nelement vertex 5", "element 'none' has 3 rows without properties"),
        ("element vertex 5", "elephant", "expected format, element, property, comment or end_header, found 'elephant'"),
        ("property float x", "property float", "header line 4: expected 'property TYPE NAME'"),
        ("property float x", "property half x", "unknown type 'half'; expected one of char"),
        ("property float y", "property float x", "a second property 'x' in element 'vertex'"),
        ("property float x\n", "", "lacks the properties x"),
        ("property float rot_3", "property float rot_4", "lacks the properties rot_3"),
        ("property float x", "property int x", "property 'x' is type i4; expected float or double"),
        ("property float opacity", "property uint opacity", "property 'opacity' is type u4"),
        ("property float x", "property list uchar float x", "property 'x' is a list; expected float or double"),
        ("property float x", "property list float float x", "a list's length has type 'float'"),
        ("property float x", "property list uchar x", "expected 'property TYPE NAME'"),
        ("property float f_dc_1", "property float g_dc_1", "lacks the properties f_dc_1"),
        ("f_rest_8", "g_rest_8", r"8 properties f_rest_\*; expected 0 \(degree 0\), 9 \(degree 1\), 24"),
        ("f_rest_8", "f_rest_9", "lacks the properties f_rest_8"),
        ("property float opacity", "property float f_rest_9\nproperty float opacity", "10 properties f_rest"),
        ("end_header\n", "", "found|no 'end_header'"),
    ],
)
def test_header_faults(tmp_path: Path, old: str, new: str, words: str) -> None:
    path = tmp_path / "bad.ply"
    path.write_bytes(edit(TEXT, old, new) + DATA)
    with pytest.raises(FormatError, match=words) as caught:
        PlySource(path)
    assert str(path) in str(caught.value)


def test_many_missing_properties_are_counted(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"f_dc_0, f_dc_1, f_dc_2, opacity, scale_0, .* and 3 more"):
        PlySource(write_rows(tmp_path / "a.ply", random_rows(2, names=["x", "y", "z"])))


def test_truncations_of_a_binary_file_at_every_length(tmp_path: Path) -> None:
    path = tmp_path / "cut.ply"
    whole = TEXT + DATA
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        with pytest.raises(FormatError) as caught:
            PlySource(path)
        if length >= len(TEXT):
            assert f"{len(DATA)} bytes from byte {len(TEXT)}; found {length - len(TEXT)}" in str(caught.value)


def test_bytes_behind_the_data_are_ignored_with_a_note(tmp_path: Path) -> None:
    plain, longer = write_rows(tmp_path / "a.ply", GOOD), write_rows(tmp_path / "b.ply", GOOD, tail=b"abc")
    source = PlySource(longer)
    assert source.notes == (*PlySource(plain).notes, "3 bytes behind the data ignored")
    for field, values in source.read(slice(0, 5), list(FIELD)).items():
        np.testing.assert_array_equal(values, PlySource(plain).read(slice(0, 5), [field])[field])


def test_a_file_of_another_program_with_bytes_behind_its_data(wild: Path) -> None:
    source = PlySource(wild / "cvlab-pc_short.ply")
    assert source.count == 100 and source.notes == ("14029 bytes behind the data ignored",)
    assert check_scene(source) is source


@pytest.mark.parametrize("kind", ["binary_little_endian", "ascii"])
@pytest.mark.parametrize("extra", ["", FACES])
def test_a_huge_count_is_refused_before_anything_is_allocated(tmp_path: Path, kind: str, extra: str) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(edit(header(GOOD, kind=kind, extra=extra), "vertex 5", "vertex 999999999999999999") + DATA)
    with pytest.raises(FormatError, match="truncated: the header promises 999999999999999999 x vertex"):
        PlySource(path)


def test_a_huge_count_of_another_element(tmp_path: Path) -> None:
    path = write_rows(tmp_path / "a.ply", GOOD, extra=edit(FACES.encode(), "face 2", "face 99999999").decode())
    with pytest.raises(FormatError, match="truncated"):
        PlySource(path)


def test_a_header_without_end_is_not_read_to_the_end(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(b"ply\n" + b"comment x\n" * 200_000)
    with pytest.raises(FormatError, match="no 'end_header' line"):
        PlySource(path)
    path.write_bytes(b"ply\ncomment" + b"x" * 3_000_000)
    with pytest.raises(FormatError, match="no 'end_header' line"):
        PlySource(path)


def ascii_file(path: Path, change: tuple[str, str] | None = None) -> Path:
    lines = "".join(" ".join(f"{value:.6f}" for value in row.tolist()) + "\n" for row in GOOD)
    if change:
        lines = edit(lines.encode(), *change).decode()
    path.write_bytes(header(GOOD, kind="ascii") + lines.encode())
    return path


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: data[:-30],  # a value cut short is a valid shorter number: cut whole values
        lambda data: data[: data.rindex(b"\n", 0, -1) + 1],
        lambda data: data.rstrip(b"\n") + b" 5\n",
        lambda data: data[:-20] + b"spam" + data[-16:],
        lambda data: data[:-20] + b"\xff\xff" + data[-18:],
    ],
)
def test_ascii_damage(tmp_path: Path, damage) -> None:  # type: ignore[no-untyped-def]
    path = ascii_file(tmp_path / "a.ply")
    assert PlySource(path).count == 5
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(FormatError, match=r"a\.ply"):
        PlySource(path)


def test_lines_behind_the_data_of_an_ascii_file(tmp_path: Path) -> None:
    path = ascii_file(tmp_path / "a.ply")
    path.write_bytes(path.read_bytes() + b"1 2 3\n\n")
    source = PlySource(path)
    assert source.count == 5 and source.notes[-1] == "5 bytes behind the data ignored"


def test_lists_cut_short_and_too_long(tmp_path: Path) -> None:
    face = bytes([3]) + np.array([0, 1, 2], "<i4").tobytes()
    text = edit(TEXT, "element vertex", FACES + "\nelement vertex")
    whole = text + face + face + DATA
    path = tmp_path / "a.ply"
    path.write_bytes(whole)
    assert PlySource(path).count == 5
    for length in range(len(text), len(whole), 7):
        path.write_bytes(whole[:length])
        with pytest.raises(FormatError):
            PlySource(path)
    path.write_bytes(whole + b"x")
    assert PlySource(path).notes[-1] == "1 bytes behind the data ignored"
    for kind, length in (("uint", b"\xff\xff\xff\xff"), ("char", b"\xff")):  # four thousand million, and minus one
        lists = f"element face 1\nproperty list {kind} uchar vertex_indices\nelement vertex"
        path.write_bytes(edit(TEXT, "element vertex", lists) + length + DATA)
        with pytest.raises(FormatError, match=r"a\.ply: .*end-of-file"):
            PlySource(path)


def test_a_signalling_nan_is_read_without_a_word(tmp_path: Path) -> None:
    rows = GOOD.copy()
    rows["x"].view("<u4")[1] = 0x7FA00000
    source = PlySource(write_rows(tmp_path / "a.ply", rows))
    assert np.isnan(source.read(slice(0, 5), ["means"])["means"][0, 1])


def test_flipped_bytes_of_the_header_never_crash(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    rng = np.random.default_rng(0)
    for position in range(0, len(TEXT), 3):
        data = bytearray(TEXT + DATA)
        data[position] ^= 1 << int(rng.integers(8))
        path.write_bytes(data)
        try:
            source = PlySource(path)
        except FlexGSError as error:
            assert isinstance(error, FormatError)
        else:
            source.read(slice(0, source.count), ["means", "sh_rest", "quats"])


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="none.ply: no such file or folder"):
        PlySource(tmp_path / "none.ply")
    with pytest.raises(InputError, match="expected a file, found a folder"):
        PlySource(tmp_path)
    (tmp_path / "empty.ply").touch()
    with pytest.raises(FormatError, match="not a PLY file"):
        PlySource(tmp_path / "empty.ply")


def test_the_table_starts_from_a_good_file(tmp_path: Path) -> None:
    assert PlySource(write_rows(tmp_path / "a.ply", GOOD)).count == 5
    assert len(property_names(1)) == len(GOOD.dtype)
