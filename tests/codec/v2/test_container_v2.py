"""Version 2 of the container: round trips through files, row ranges, layers, trimming, sizes and the golden file."""

from __future__ import annotations

import importlib.util
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import educational_decoder2
from fgs_damage import away
from flexgs_edge.codec.open_fgs import file_version, open_fgs, read_header, verify
from flexgs_edge.codec.v1.container import write_container
from flexgs_edge.codec.v1.packed_source import FgsSource
from flexgs_edge.codec.v2.container import GridContainer, Preview, channel_bytes, coded_size, trim_container, write_grid
from flexgs_edge.codec.v2.encode import encode_grid
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.commands.decompress import decompress
from flexgs_edge.errors import FormatError, InputError, TargetError
from flexgs_edge.grid.grid_scene import GridScene, from_grid
from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.scene.check import check_scene
from flexgs_edge.scene.fields import FIELDS
from grid_scenes import assert_same_grid, make_grid
from quantized_scenes import make_scene, quantize_all
from scene_files import open_scene

NAMES = [field.name for field in FIELDS]
GOLDEN = Path(__file__).parents[2] / "golden"


@settings(max_examples=8, deadline=None)
@given(
    st.integers(0, 700),
    st.integers(0, 4),
    st.integers(1, 4),
    st.sampled_from([64, 300, 65536]),
    st.dictionaries(st.text(max_size=5), st.text(max_size=900), max_size=4),
)
def test_round_trip_and_size(tmp_path_factory, count, degree, layers, chunk_rows, record) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path_factory.mktemp("size") / "a.fgs"
    grid = make_grid(count, degree, layers=layers)
    size = write_grid(path, grid, record, chunk_rows=chunk_rows)
    assert size == path.stat().st_size == coded_size(grid, record, chunk_rows)
    source = GridSource(path)
    assert {name: value for name, value in source.settings.items() if name != "boxes"} == record
    assert_same_grid(source.grid(), grid)
    assert sum(section.length for section in verify(path)) == size


@pytest.mark.parametrize("count", [0, 1, 2, 3, 500])
def test_values(tmp_path: Path, count: int) -> None:
    path = tmp_path / "a.fgs"
    grid = make_grid(count, 2, layers=2)
    write_grid(path, grid, {}, chunk_rows=100)
    source = open_scene(path)
    assert isinstance(source, GridSource)
    assert (source.count, source.sh_degree) == (count, grid.sh_degree)
    np.testing.assert_array_equal(source.origin, [1234.5, -0.1, 1e-7])
    expected = from_grid(grid)
    got = source.read(slice(0, count), NAMES)
    for name, plane in expected.items():
        assert got[name].tobytes() == plane.tobytes()


def test_parts_of_a_scene(tmp_path: Path) -> None:
    path = tmp_path / "a.fgs"
    grid = make_grid(500, 2)
    write_grid(path, grid, {}, chunk_rows=64)
    expected, source = from_grid(grid), GridSource(path)
    rng = np.random.default_rng(0)
    parts = [slice(0, 0), slice(499, 500), slice(63, 65), slice(64, 128), slice(10, 400), np.array([], np.int64)]
    parts += [np.array([0, 63, 64, 499]), np.array([5, 5]), np.sort(rng.choice(500, 90, replace=False))]
    for rows in parts:
        for names in (NAMES, ["means"], ["sh_rest", "quats"]):
            for name, plane in source.read(rows, names).items():
                np.testing.assert_array_equal(plane, expected[name][:, rows])
    out = {"means": np.empty((3, 7), np.float32)}
    assert source.read(slice(60, 67), ["means"], out)["means"] is out["means"]
    with pytest.raises(IndexError):
        source.read(slice(0, 501), NAMES)
    shuffled = rng.permutation(500)
    got = source.select(shuffled).read(slice(0, 500), ["quats"])["quats"]
    np.testing.assert_array_equal(got, expected["quats"][:, shuffled])


def test_a_file_of_many_chunks_tells_where_they_lie(tmp_path: Path) -> None:
    path = tmp_path / "a.fgs"
    grid = make_grid(900, 2, layers=2)
    write_grid(path, grid, {"a": 1, "boxes": "of another file"}, chunk_rows=100)
    container = GridContainer(path)
    boxes = container.header.settings["boxes"]
    assert len(boxes) == container.header.chunk_count >= 9
    for chunk, (*ends, with_sh) in zip(container.header.chunks(), boxes, strict=True):
        position = grid.position[:, chunk.start : chunk.stop]
        assert ends == [*position.min(axis=1), *position.max(axis=1)]
        assert with_sh == np.count_nonzero(grid.sh_degrees[chunk.start : chunk.stop])
    write_grid(path, grid, {"a": 1}, chunk_rows=200, force=True)
    assert GridContainer(path).header.settings == {"a": 1}


def with_preview(folder: Path, small: GridScene, **words: Any) -> Path:
    """A file of 900 rows in two layers, with a file of `small` as its preview."""
    path, inner = folder / "a.fgs", folder / "small.fgs"
    write_grid(inner, small, {"small": True}, force=True, **words)
    size = write_grid(path, make_grid(900, 2, layers=2), {"a": 1}, force=True, preview=inner.read_bytes())
    assert size == path.stat().st_size
    return path


def test_a_preview_is_a_file_in_the_file(tmp_path: Path) -> None:
    grid, small = make_grid(900, 2, layers=2), make_grid(40)
    path = with_preview(tmp_path, small)
    plain = tmp_path / "plain.fgs"
    size = write_grid(plain, grid, {"a": 1})
    inner = (tmp_path / "small.fgs").read_bytes()
    assert coded_size(grid, {"a": 1}, preview=inner) == path.stat().st_size > size + len(inner)
    container = GridContainer(path)
    assert container.read_preview() == inner and Preview(container).header.settings == {"small": True}
    assert_same_grid(GridSource(path).grid(), GridSource(plain).grid())
    header, planes = educational_decoder2.decode(path.read_bytes())
    assert header["preview_bytes"] == len(inner)
    np.testing.assert_array_equal(planes["means"], educational_decoder2.decode(plain.read_bytes())[1]["means"])
    assert [section.name for section in verify(path)] == [
        "preamble", "header", "model", "preview", "chunk 0", "chunk 1", "chunk table",
    ]  # fmt: skip
    assert channel_bytes(path)["preview"] == len(inner) and channel_bytes(plain)["preview"] == 0


def test_a_file_that_is_cut_keeps_its_preview_or_is_it(tmp_path: Path) -> None:
    path, cut = with_preview(tmp_path, make_grid(40)), tmp_path / "cut.fgs"
    inner = (tmp_path / "small.fgs").read_bytes()
    layers = [entry.section for entry in GridContainer(path).read_table()]
    first = path.stat().st_size - layers[1].length + 60  # the header grows by what it was cut from
    assert trim_container(path, cut, first) == cut.stat().st_size
    assert GridContainer(cut).header.layers == GridContainer(path).header.layers[:1]
    assert GridContainer(cut).read_preview() == inner
    verify(cut)
    assert trim_container(path, cut, len(inner), force=True) == len(inner) and cut.read_bytes() == inner
    with pytest.raises(TargetError, match="its first layer needs"):
        trim_container(path, cut, len(inner) - 1, force=True)


def test_damage_and_faults_of_a_preview_are_found(tmp_path: Path) -> None:
    path = with_preview(tmp_path, make_grid(40))
    section = GridContainer(path).header.preview
    data = path.read_bytes()
    for at in range(section.offset, section.offset + section.length, 37):
        path.write_bytes(data[:at] + bytes([data[at] ^ 16]) + data[at + 1 :])
        with pytest.raises(FormatError, match=r"\(preview\): byte \d+: "):
            verify(path)
        assert [each.name for each in verify(path, raise_errors=False) if not each.ok] == ["preview"]
    moved = replace(make_grid(40), origin=np.array([1.0, 2.0, 3.0]))
    with pytest.raises(FormatError, match="origin: wanted"):
        verify(with_preview(tmp_path, moved))
    with pytest.raises(FormatError, match="sh_degree: wanted 0 or 2 in a preview, got 1"):
        verify(with_preview(tmp_path, make_grid(40, 1)))
    small = tmp_path / "small.fgs"
    with pytest.raises(FormatError, match="preview_bytes: wanted none in a preview"):
        verify(with_preview(tmp_path, make_grid(40), preview=small.read_bytes()))


def test_boxes_can_be_left_out(tmp_path: Path) -> None:
    write_grid(tmp_path / "a.fgs", make_grid(900), {}, chunk_rows=64, boxes=False)
    assert GridContainer(tmp_path / "a.fgs").header.settings == {}


def test_only_touched_chunks_are_decoded(tmp_path: Path) -> None:
    """Without its file, a source gives what it holds: the chunk that was decoded last, its SH only where they were asked for."""
    path = tmp_path / "a.fgs"
    write_grid(path, make_grid(500), {}, chunk_rows=64)
    source = GridSource(path)
    means, sh_rest, other = (slice(130, 131), ["means"]), (slice(130, 131), ["sh_rest"]), (slice(127, 128), ["means"])
    for asked, refused in ((means, [sh_rest, other]), (sh_rest, [other])):
        source.read(*asked)
        with away(path):
            for row in range(130, 150):
                source.read(slice(row, row + 1), ["means"])
            for words in refused:
                with pytest.raises(InputError):
                    source.read(*words)
        source.read(*means)  # what is refused takes the chunk's place
    with away(path):
        source.read(*means)


def test_a_scene_is_decoded_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From file to PLY: the check of values has nothing to find in a grid."""
    path = tmp_path / "a.fgs"
    # Far from zero, positions are read once more: do floats hold them?
    write_grid(path, replace(make_grid(300, 1), origin=np.zeros(3)), {}, chunk_rows=100)
    decoded: list[str] = []
    plain = GridContainer.decode

    def counted(self, model, chunk, entry, base_only=False):  # type: ignore[no-untyped-def]
        decoded.append(entry.section.name)
        return plain(self, model, chunk, entry, base_only)

    monkeypatch.setattr(GridContainer, "decode", counted)
    decompress(path, tmp_path / "a.ply")
    assert decoded == ["chunk 0", "chunk 1", "chunk 2"]


@pytest.mark.parametrize(
    ("rotation", "colour", "fault"),
    [(2.0**38, 2.0**20, None), (2.0**70, 2.0**20, "quats of norm zero"), (2.0**38, 2.0**30, "beyond .* in sh_dc")],
)
def test_the_largest_codes_are_valid_values(tmp_path: Path, rotation: float, colour: float, fault: str | None) -> None:
    """A grid is taken unchecked only where every code gives a value that the check would pass."""
    path = tmp_path / "a.fgs"
    steps = StepSizes(*[2.0**80] * 4, colour, (colour,) * 4, 2.0**4)
    grid = make_grid(20, 1)
    for plane in (grid.position, grid.scale, grid.rotation, grid.opacity, grid.dc, *grid.sh):
        plane[:] = 2**24
    write_grid(path, replace(grid, step_sizes=replace(steps, rotation=rotation, sh=steps.sh[:1])), {})
    source = GridSource(path)
    assert source.valid == (fault is None)
    source.valid = False
    if fault is None:
        assert check_scene(source) is source
    else:
        with pytest.raises(InputError, match=fault), np.errstate(over="ignore"):
            check_scene(source)


def test_real_chunk_boundary(tmp_path: Path) -> None:
    path = tmp_path / "a.fgs"
    grid = make_grid(65536 + 9, 0)
    write_grid(path, grid, {})
    names = [section.name for section in verify(path)]
    assert names == ["preamble", "header", "model", "chunk 0", "chunk 1", "chunk table"]
    near = GridSource(path).read(slice(65530, 65545), ["quats"])["quats"]
    np.testing.assert_array_equal(near, from_grid(grid, slice(65530, 65545))["quats"])


def test_trim_keeps_whole_layers(tmp_path: Path) -> None:
    path, cut, again = tmp_path / "a.fgs", tmp_path / "b.fgs", tmp_path / "c.fgs"
    grid = make_grid(900, 2, layers=4)
    size = write_grid(path, grid, {"a": 1}, chunk_rows=100)
    expected = from_grid(grid)
    settings, counts = GridSource(path).settings, np.bincount(grid.layer)
    largest = size
    for layers in (3, 2, 1):
        written = trim_container(path if layers == 3 else cut, again, largest - 1)
        again.replace(cut)
        assert written == cut.stat().st_size < largest
        largest = written
        verify(cut)
        source = GridSource(cut)
        assert source.count == counts[:layers].sum()
        assert source.container.header.layers == tuple(counts[:layers])
        assert source.container.header.cut_from == {"bytes": size, "count": 900, "layers": 4}
        assert source.settings == settings
        for name, plane in source.read(slice(0, source.count), NAMES).items():
            np.testing.assert_array_equal(plane, expected[name][:, : source.count])
    with pytest.raises(TargetError, match="first layer needs"):
        trim_container(cut, again, 100)
    assert not again.exists()


def test_trim_to_enough_room_copies(tmp_path: Path) -> None:
    path, copy = tmp_path / "a.fgs", tmp_path / "b.fgs"
    size = write_grid(path, make_grid(50, layers=2), {})
    assert trim_container(path, copy, size) == size
    assert copy.read_bytes() == path.read_bytes()
    with pytest.raises(InputError, match="exists"):
        trim_container(path, copy, size)
    trim_container(path, copy, size, force=True)
    with pytest.raises(InputError, match="another file"):
        trim_container(path, path, size, force=True)


def test_channel_bytes_add_up(tmp_path: Path) -> None:
    path = tmp_path / "a.fgs"
    size = write_grid(path, make_grid(3000, 2), {}, chunk_rows=1024)
    table = channel_bytes(path)
    assert sum(table.values()) == pytest.approx(size)
    assert min(table.values()) >= 0
    assert 0 < table["sh 2 Cg"] < table["position"]


def test_both_versions_by_one_door(tmp_path: Path) -> None:
    one, two = tmp_path / "one.fgs", tmp_path / "two.fgs"
    write_container(one, quantize_all(make_scene(9)), {})
    write_grid(two, make_grid(9), {})
    assert (file_version(one), file_version(two)) == (1, 2)
    assert isinstance(open_fgs(one), FgsSource) and isinstance(open_fgs(two), GridSource)
    for path in (one, two):
        assert read_header(path).count == 9
        assert all(section.ok for section in verify(path))
    with pytest.raises(InputError, match="no such file or folder"):
        read_header(tmp_path / "none.fgs")


@pytest.mark.parametrize("value", [float("nan"), {1, 2}, b"x", "x" * (1 << 20)])
def test_settings_that_json_cannot_hold(tmp_path: Path, value: object) -> None:
    with pytest.raises(InputError, match="settings"):
        write_grid(tmp_path / "a.fgs", make_grid(3), {"a": value})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("count", "degree", "layers", "chunk_rows"),
    [(0, 0, 1, 64), (1, 0, 1, 64), (300, 0, 2, 200), (300, 1, 1, 65536), (280, 2, 3, 128), (600, 3, 2, 400)],
)
def test_the_written_format(tmp_path: Path, count: int, degree: int, layers: int, chunk_rows: int) -> None:
    """A decoder written from docs/format.md alone finds the same values, escapes and raw bits among them."""
    path = tmp_path / "a.fgs"
    grid = make_grid(count, degree, layers=layers)
    rng = np.random.default_rng(0)
    grid.dc[1] = rng.integers(-(2**13), 2**13, count)
    grid.scale[0, :1] = 2**24
    write_grid(path, grid, {}, chunk_rows=chunk_rows)
    check_written_format(path)


def check_written_format(path: Path) -> None:
    header, values = educational_decoder2.decode(path.read_bytes())
    source = GridSource(path)
    assert header["settings"] == source.settings
    for name, plane in source.read(slice(0, source.count), NAMES).items():
        np.testing.assert_array_equal(values[name], plane, name)


def regenerator() -> ModuleType:
    spec = importlib.util.spec_from_file_location("regenerate_v2", GOLDEN / "regenerate_v2.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_golden_bytes(tmp_path: Path) -> None:
    module = regenerator()
    module.main(tmp_path)
    assert (tmp_path / "tiny.fgs").read_bytes() == (GOLDEN / "v2" / "tiny.fgs").read_bytes()
    check_written_format(GOLDEN / "v2" / "tiny.fgs")


@pytest.mark.parametrize("name", ["tiny", "early"])
def test_golden_files_are_read(name: str) -> None:
    source = GridSource(GOLDEN / "v2" / f"{name}.fgs")
    with np.load(GOLDEN / "v2" / "tiny.npz") as expected:
        for field, plane in source.read(slice(0, source.count), NAMES).items():
            assert plane.tobytes() == expected[field].tobytes()
    assert source.settings == regenerator().SETTINGS
    assert source.container.header.layers == (200, 200)
    assert (source.container.header.channels is None) == (name == "early")


def test_the_share_of_sh_is_what_leaving_them_out_saves() -> None:
    grid = make_grid(2000, 2)
    bare = replace(
        grid, sh_degree=0, step_sizes=replace(grid.step_sizes, sh=()), sh_degrees=np.zeros_like(grid.sh_degrees), sh=()
    )
    assert coded_size(grid, {}) - encode_grid(grid).sh_bytes == pytest.approx(coded_size(bare, {}), rel=0.005)
    assert encode_grid(bare).sh_bytes == 0
