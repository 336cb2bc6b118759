"""Reading PLY scenes: every layout that is valid gives the same arrays, by any rows."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexgs_edge.errors import InputError
from flexgs_edge.io.ply import PlySource, choose_origin, write_ply
from flexgs_edge.scene.fields import FIELDS
from flexgs_edge.scene.source import MemorySource
from scene_files import header, planes_of, property_names, random_rows, write_rows

ALL = [field.name for field in FIELDS]
SAMPLE = Path(__file__).parents[2] / "samples" / "still_life" / "point_cloud.ply"


def assert_same(source: PlySource, rows: np.ndarray) -> None:
    """All fields of `source` against the structured `rows` (positions plus origin)."""
    assert source.count == len(rows)
    read = source.read(slice(0, source.count), ALL)
    for field in FIELDS:
        names = field.ply_names(source.sh_degree)
        found = read[field.name].astype(np.float64)
        if field.name == "means":
            found = found + source.origin[:, None]
        assert found.shape == (len(names), len(rows))
        np.testing.assert_array_equal(found.astype(np.float32), planes_of(rows, names), err_msg=field.name)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
@pytest.mark.parametrize("count", [0, 1, 17])
def test_degrees_and_byte_orders(tmp_path: Path, count: int, degree: int, order: str) -> None:
    rows = random_rows(count, degree, order=order)
    source = PlySource(write_rows(tmp_path / "a.ply", rows))
    assert (source.sh_degree, source.sh_count) == (degree, count if degree else 0)
    assert source.notes == ()
    assert_same(source, rows)


@pytest.mark.parametrize("double", ["xyz", "xyzforsn", "f"])
@pytest.mark.parametrize("order", ["<", ">"])
def test_float64_properties(tmp_path: Path, order: str, double: str) -> None:
    rows = random_rows(9, 1, order=order, double=double)
    assert_same(PlySource(write_rows(tmp_path / "a.ply", rows)), rows)


def test_any_property_order_and_no_normals(tmp_path: Path) -> None:
    names = property_names(2, normals=False)
    shuffled = [str(name) for name in np.random.default_rng(3).permutation(names)]
    rows = random_rows(5, names=shuffled)
    assert_same(PlySource(write_rows(tmp_path / "a.ply", rows)), rows)


def test_extra_properties_are_left_out_with_a_note(tmp_path: Path) -> None:
    plain = random_rows(5, 1)
    extra = np.zeros(5, np.dtype([("red", "u1"), *plain.dtype.descr, ("id", "<i4"), ("confidence", "<f4")]))
    for name in plain.dtype.names or ():
        extra[name] = plain[name]
    extra["red"], extra["id"] = 200, 7
    source = PlySource(write_rows(tmp_path / "a.ply", extra))
    assert source.notes == ("extra properties left out: red, id, confidence",)
    assert_same(source, plain)


@pytest.mark.parametrize("comment", ["", "made by hand", "Vertical axis: z", "end_header? no", "caf\u00e9"])
def test_header_comments_and_line_ends(tmp_path: Path, comment: str) -> None:
    rows = random_rows(3)
    text = header(rows, comment=comment or "x")
    (tmp_path / "a.ply").write_bytes(text.replace(b"\n", b"\r\n") + rows.tobytes())
    assert_same(PlySource(tmp_path / "a.ply"), rows)
    (tmp_path / "b.ply").write_bytes(text.replace(b"comment", b"obj_info") + rows.tobytes())
    assert_same(PlySource(tmp_path / "b.ply"), rows)


@pytest.mark.parametrize(
    ("comments", "antialiased"),
    [
        ("SplatRenderMode: mip", True),
        ("SplatRenderMode: default", False),
        ("splatrendermode: MIP", True),
        ("antialiased 1", True),
        ("antialiased 0", False),
        ("antialiased 1\ncomment SplatRenderMode: default", False),  # the last one holds
        ("SplatRenderMode: 2dgs", None),
        ("not antialiased 1", None),
        ("antialiased", None),
        ("", None),
    ],
)
def test_comments_that_say_how_the_model_was_trained(tmp_path: Path, comments: str, antialiased: bool | None) -> None:
    source = PlySource(write_rows(tmp_path / "a.ply", random_rows(3), comment=comments))
    assert source.settings == ({} if antialiased is None else {"antialiased": antialiased})


def test_a_filter_counts_more_than_a_comment(tmp_path: Path) -> None:
    rows = random_rows(3, names=[*property_names(0), "filter_3D"])
    rows["filter_3D"] = 0.1
    source = PlySource(write_rows(tmp_path / "a.ply", rows, comment="SplatRenderMode: default"))
    assert source.settings == {"antialiased": True}


def test_other_plain_elements_around_the_vertices(tmp_path: Path) -> None:
    rows = random_rows(4, 1)
    text = header(rows, extra="element after 2\nproperty uchar v")
    text = text.replace(b"element vertex", b"element before 3\nproperty short a\nproperty double b\nelement vertex")
    (tmp_path / "a.ply").write_bytes(text + bytes(30) + rows.tobytes() + b"zz")
    source = PlySource(tmp_path / "a.ply")
    assert source.notes == ("element 'before' left out (3 rows)", "element 'after' left out (2 rows)")
    assert_same(source, rows)


def ascii_text(rows: np.ndarray) -> bytes:
    lines = [" ".join(repr(float(value)) for value in row.tolist()) for row in rows]
    return header(rows, kind="ascii", comment="caf\u00e9") + "".join(line + "\n" for line in lines).encode()


@pytest.mark.parametrize("count", [0, 1, 5])
@pytest.mark.parametrize("degree", [0, 3])
def test_ascii(tmp_path: Path, count: int, degree: int) -> None:
    rows = random_rows(count, degree)
    (tmp_path / "a.ply").write_bytes(ascii_text(rows))
    source = PlySource(tmp_path / "a.ply")
    assert_same(source, rows)
    (tmp_path / "b.ply").write_bytes(ascii_text(rows).rstrip(b"\n") + b"\n\n \n")
    if count:
        assert_same(PlySource(tmp_path / "b.ply"), rows)


@pytest.mark.parametrize("first", [False, True])
@pytest.mark.parametrize("order", ["<", ">"])
def test_lists_in_other_elements(tmp_path: Path, order: str, first: bool) -> None:
    rows = random_rows(6, 1, order=order)
    faces = b"".join(bytes([3]) + np.array([0, 1, k], order + "i4").tobytes() for k in range(2))
    lists = "element face 2\nproperty list uchar int vertex_indices"
    text, data = header(rows, extra=lists, comment="caf\u00e9"), rows.tobytes() + faces
    if first:
        text = header(rows, comment="caf\u00e9").replace(b"element vertex", lists.encode() + b"\nelement vertex")
        data = faces + rows.tobytes()
    (tmp_path / "a.ply").write_bytes(text + data)
    source = PlySource(tmp_path / "a.ply")
    assert source.notes == ("element 'face' left out (2 rows)",)
    assert_same(source, rows)
    np.testing.assert_array_equal(
        source.read(np.array([1, 4]), ["quats"])["quats"], source.read(slice(0, 6), ["quats"])["quats"][:, [1, 4]]
    )


def test_plyfile_is_imported_only_where_it_is_needed(tmp_path: Path) -> None:
    path = write_rows(tmp_path / "a.ply", random_rows(3))
    code = (
        "import sys; from flexgs_edge.run.open_scene import open_file; from flexgs_edge.scene.check import check_scene; "
        f"check_scene(open_file({str(path)!r}).source); "
        "sys.exit(' '.join({'plyfile', 'PIL', 'pyopencl', 'skimage'} & set(sys.modules)) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[2], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.fixture(scope="module")
def long_file(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[int, PlySource], np.ndarray]:
    """A file, read by blocks of any size."""
    rows = random_rows(3000, 1)
    path = write_rows(tmp_path_factory.mktemp("long") / "a.ply", rows)
    return {size: PlySource(path, block_rows=size) for size in (1, 3, 64, 4096)}, rows


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_any_rows_in_any_block_size(long_file: tuple[dict[int, PlySource], np.ndarray], data: st.DataObject) -> None:
    sources, rows = long_file
    source = sources[data.draw(st.sampled_from(sorted(sources)))]
    if data.draw(st.booleans()):
        start = data.draw(st.integers(0, 3000))
        where: slice | np.ndarray = slice(start, data.draw(st.integers(start, min(3000, start + 300))))
    else:  # clusters of neighbours, far apart and near, sorted or not, with repeats
        starts = data.draw(st.lists(st.integers(0, 2990), max_size=12))
        where = np.array([s + k for s in starts for k in range(data.draw(st.integers(1, 9)))], np.int64)
        if data.draw(st.booleans()):
            where.sort()
    read = source.read(where, ["quats", "sh_rest"])
    np.testing.assert_array_equal(read["quats"], planes_of(rows[where], FIELDS[5].ply))
    np.testing.assert_array_equal(read["sh_rest"], planes_of(rows[where], FIELDS[2].ply_names(1)))


def test_a_file_changed_after_opening_is_noticed(tmp_path: Path) -> None:
    path = write_rows(tmp_path / "a.ply", random_rows(5))
    source = PlySource(path)
    write_rows(tmp_path / "b.ply", random_rows(5, seed=1)).replace(path)
    with pytest.raises(InputError, match=r"a\.ply: the file was changed after it was opened"):
        source.read(slice(0, 1), ["means"])
    path.unlink()
    with pytest.raises(InputError, match="cannot read the scene"):
        source.read(slice(0, 1), ["means"])


def test_a_scene_far_from_zero_keeps_its_digits(tmp_path: Path) -> None:
    rows = random_rows(1000, double="xyz")
    world = np.random.default_rng(1).uniform(-8.0, 8.0, (3, 1000)) + np.array([[4e6], [-5e5], [123.0]])
    for axis, name in enumerate("xyz"):
        rows[name] = world[axis]
    source = PlySource(write_rows(tmp_path / "a.ply", rows))
    np.testing.assert_array_equal(source.origin, [4e6, -5e5, 128.0])
    means = source.read(slice(0, 1000), ["means"])["means"]
    assert np.abs(means + source.origin[:, None] - world).max() < 1e-6  # float32 alone would be off by 0.25


def test_doubles_beyond_float32_become_infinite(tmp_path: Path) -> None:
    rows = random_rows(3, double="o")
    rows["opacity"][1] = 1e300
    found = PlySource(write_rows(tmp_path / "a.ply", rows)).read(slice(0, 3), ["opacity_logits"])["opacity_logits"]
    assert np.isinf(found[0]).tolist() == [False, True, False]


@pytest.mark.parametrize(
    ("positions", "origin"),
    [
        (np.zeros((0, 3)), [0, 0, 0]),
        (np.full((4, 3), np.nan), [0, 0, 0]),
        (np.full((1, 3), 17.4), [17, 17, 17]),
        ([[-1, -1, -1], [1.2, 1, 1]], [0, 0, 0]),
        ([[-0.3, 0, 0], [-0.1, 1, 1]], [0, 0, 0]),
        ([[1000, 0, 0], [1003, 0, 0]], [1000, 0, 0]),
        ([[1000, 0, np.inf], [500, 0, 0]], [500, 0, 0]),
        ([[1000, 0, 0], [500, 0, 0]], [0, 0, 0]),
        ([[1e308, 0, 0], [-1e308, 0, 0]], [0, 0, 0]),
        ([[1e300, 0, 0], [1e300, 1e-310, 0]], [0, 0, 0]),
    ],
)
def test_the_origin(positions: list[list[float]], origin: list[float]) -> None:
    found = choose_origin(np.array(positions, np.float64))
    np.testing.assert_array_equal(found, origin)
    assert not np.signbit(found[found == 0]).any()


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(1e-3, 1e4), st.tuples(*[st.floats(-1e7, 1e7) for _ in range(3)]))
def test_the_origin_is_on_the_grid_and_near_the_middle(seed: int, size: float, centre: tuple[float, ...]) -> None:
    positions = np.random.default_rng(seed).uniform(-size, size, (200, 3)) + centre
    origin = choose_origin(positions)
    low, high = np.quantile(positions, (0.05, 0.95), axis=0)
    grid = 2.0 ** np.ceil(np.log2((high - low).max()))
    middle = (low + high) / 2
    if not origin.any():
        assert (np.abs(middle) <= 16.5 * grid).all()
        return
    assert (np.abs(origin - middle) <= grid / 2).all() and (np.abs(middle) > 16 * grid).any()
    np.testing.assert_array_equal(origin / grid, np.round(origin / grid))


def test_the_origin_does_not_follow_a_few_outliers(tmp_path: Path) -> None:
    rows = random_rows(1000)
    rows["x"][:20] = 1e9
    assert (PlySource(write_rows(tmp_path / "a.ply", rows)).origin == 0).all()


def test_the_sample_against_plyfile() -> None:
    from plyfile import PlyData

    source = PlySource(SAMPLE)
    assert (source.count, source.sh_degree, source.origin.tolist(), source.notes) == (32980, 3, [0.0, 0.0, 0.0], ())
    assert_same(source, PlyData.read(SAMPLE)["vertex"].data)


def test_colours_of_8_bits(tmp_path: Path) -> None:
    names = [name for name in property_names(0) if not name.startswith("f_dc")]
    plain = random_rows(256, names=names)
    rows = np.zeros(256, [*plain.dtype.descr, *((name, "u1") for name in ("red", "green", "blue"))])
    for name in names:
        rows[name] = plain[name]
    rows["red"], rows["green"], rows["blue"] = np.arange(256), np.arange(256)[::-1], 7
    source = PlySource(write_rows(tmp_path / "a.ply", rows))
    assert any("read from red, green, blue" in note for note in source.notes)
    dc = source.read(slice(0, 256), ["sh_dc"])["sh_dc"]
    expected = (np.array([rows["red"], rows["green"], rows["blue"]]) / 255 - 0.5) / 0.28209479177387814
    np.testing.assert_array_equal(dc, expected.astype(np.float32))
    ours = MemorySource({name: source.read(slice(0, 256), [name])[name] for name in ALL})
    write_ply(tmp_path / "b.ply", ours)
    np.testing.assert_array_equal(PlySource(tmp_path / "b.ply").read(slice(0, 256), ["sh_dc"])["sh_dc"], dc)
    names = [*property_names(0), "red"]
    assert PlySource(write_rows(tmp_path / "c.ply", random_rows(2, names=names))).notes == (
        "extra properties left out: red",
    )


def test_ascii_gaussians_of_a_cube(tmp_path: Path) -> None:
    rows = random_rows(20)
    for axis, name in enumerate("xyz"):
        rows[name] = np.arange(20) >> axis & 1
    lines = [" ".join(f"{value:.9g}" for value in row) for row in rows.tolist()]
    (tmp_path / "a.ply").write_bytes(header(rows, "ascii") + "\n".join(lines).encode() + b"\n")
    assert_same(PlySource(tmp_path / "a.ply"), rows)
