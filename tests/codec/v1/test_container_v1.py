"""The container: round trips, sizes, golden bytes, and an independent decoder."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import educational_decoder
import flexgs_edge.codec.v1.container as layout
from benchmarks.quantize import dequantized
from fgs_damage import away
from flexgs_edge.codec.sections import canonical_json
from flexgs_edge.codec.v1.container import (
    HEADER_OWN,
    Header,
    container_size,
    encode_header,
    header_block,
    read_header,
    verify,
    write_container,
)
from flexgs_edge.codec.v1.packed_source import FgsSource
from flexgs_edge.errors import InputError
from flexgs_edge.packed.bitpack import PAPER, BitSpec
from flexgs_edge.packed.quantize import dequantize
from flexgs_edge.scene.fields import FIELDS
from flexgs_edge.scene.source import Planes, Rows, SceneSource
from quantized_scenes import assert_same_codes, make_scene, quantize_all
from scene_files import open_scene

NAMES = [field.name for field in FIELDS]
GOLDEN = Path(__file__).parents[2] / "golden"


@pytest.fixture
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> int:
    """Chunks of 64 rows, so that many chunks cost little (the format's constant is checked by the golden file)."""
    for module in ("container", "packed_source"):
        monkeypatch.setattr(f"flexgs_edge.codec.v1.{module}.CHUNK_ROWS", 64)
    return 64


def whole(source: SceneSource) -> Planes:
    return source.read(slice(0, source.count), NAMES)


@pytest.mark.parametrize("count", [0, 1, 63, 64, 65, 300])
@pytest.mark.parametrize("degree", [0, 1, 4])
def test_decoding_gives_the_quantizers_own_bits(tmp_path: Path, small_chunks: int, count: int, degree: int) -> None:
    quantized = quantize_all(make_scene(count, degree), BitSpec(13, 7, 8, 16, 1, 3), 4)
    path = tmp_path / "a.fgs"
    size = write_container(path, quantized, {"near": 0.2})
    assert size == path.stat().st_size
    source = FgsSource(path)
    assert source.settings == {"near": 0.2}
    assert (source.count, source.sh_count, source.sh_degree) == (count, quantized.sh_count, quantized.sh_degree)
    assert_same_codes(source.quantized(), quantized)
    values, memory = whole(source), whole(dequantized(quantized))
    for name, array in quantized.arrays.items():
        expected = np.zeros((array.channels, count), np.float32)
        expected[:, : array.count] = dequantize(array, slice(None))
        assert values[name].tobytes() == memory[name].tobytes() == expected.tobytes()
    assert all(section.ok for section in verify(path))


def test_any_rows_equal_those_of_the_whole(tmp_path: Path, small_chunks: int) -> None:
    path = tmp_path / "a.fgs"
    quantized = quantize_all(make_scene(500, 1))
    write_container(path, quantized, {})
    rng = np.random.default_rng(0)
    lists = [np.sort(rng.choice(500, n, replace=False)) for n in (0, 1, 7, 100, 499)]
    parts: list[Rows] = [
        slice(0, 0),
        slice(63, 65),
        slice(17, 18),
        slice(200, 500),
        np.array([499]),
        np.array([5, 5, 6]),
        *lists,
    ]
    for source in (FgsSource(path), dequantized(quantized)):
        reference = whole(source)
        for rows in parts:
            for name, plane in source.read(rows, NAMES).items():
                np.testing.assert_array_equal(plane, reference[name][:, rows])
        shuffled = rng.permutation(500)
        means = source.select(shuffled).read(slice(0, 500), ["means"])["means"]
        np.testing.assert_array_equal(means, reference["means"][:, shuffled])


def test_a_chunk_is_read_once_in_a_row(tmp_path: Path, small_chunks: int) -> None:
    """Without its file, a source gives what it holds: the chunk that was read last, and no other."""
    path = tmp_path / "a.fgs"
    write_container(path, quantize_all(make_scene(200)), {})
    source = FgsSource(path)
    for first, others in ((0, (64, 199)), (64, (0, 128))):
        source.read(slice(first, first + 1), ["means"])
        with away(path):
            for row in range(first, first + 64):
                source.read(slice(row, row + 1), ["means", "sh_rest"])
            for row in others:
                with pytest.raises(InputError):
                    source.read(slice(row, row + 1), ["means"])


def test_real_chunk_boundary(tmp_path: Path) -> None:
    path = tmp_path / "a.fgs"
    quantized = quantize_all(make_scene(65536 + 9, 0), BitSpec(3, 3, 3, 3, 3, 3), 10)
    assert write_container(path, quantized, {}) == container_size(65545, 0, 0, quantized.bits, 10)
    assert [s.name for s in verify(path)] == ["preamble", "header", "ranges", "chunk 0", "chunk 1", "chunk table"]
    near = FgsSource(path).read(slice(65530, 65545), ["quats"])["quats"]
    np.testing.assert_array_equal(near, dequantize(quantized.arrays["quats"], slice(65530, 65545)))


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 700),
    st.integers(0, 4),
    st.lists(st.integers(1, 16), min_size=6, max_size=6),
    st.sampled_from([None, 1, 3, 100]),
    st.dictionaries(st.text(max_size=5), st.text(max_size=900), max_size=4),
)
def test_size_model_and_round_trip(tmp_path_factory, count, degree, bits, groups, record) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path_factory.mktemp("size") / "a.fgs"
    quantized = quantize_all(make_scene(count, degree), BitSpec(*bits), groups)
    size = write_container(path, quantized, record)
    assert size == path.stat().st_size
    assert size == container_size(count, quantized.sh_count, degree, quantized.bits, groups, record)
    source = FgsSource(path)
    assert source.settings == record
    assert_same_codes(source.quantized(), quantized)


def test_size_does_not_depend_on_figures() -> None:
    short, long = {"drop": 0.5}, {"drop": -0.12345678901234567, "note": "x" * 1400}
    assert container_size(9, 3, 1, PAPER) == container_size(9, 3, 1, PAPER, settings=short)
    assert container_size(9, 3, 1, PAPER, settings=short) == container_size(9, 3, 1, PAPER, settings=long)
    assert container_size(9, 3, 1, PAPER, settings={"note": "x" * 1600}) == container_size(9, 3, 1, PAPER) + 1024
    # SH of a degree above 0 without rows that have them cost nothing.
    assert container_size(9, 0, 3, PAPER) == container_size(9, 0, 0, PAPER)


def test_the_longest_header_fits_beside_the_settings() -> None:
    largest = 2**32 - 1
    groups = dict.fromkeys(("xyz", "dc", "rest", "opacity", "scale", "rot"), largest)
    origin = (-1.2345678901234567e-300,) * 3
    header = Header(largest, largest, 4, origin, BitSpec.rtn(16), groups, {})
    assert len(encode_header(header).rstrip()) <= HEADER_OWN


@pytest.mark.parametrize("value", [float("nan"), float("inf"), {1, 2}, np.float32(1), b"x", "x" * (1 << 20)])
def test_settings_that_json_cannot_hold(tmp_path: Path, value: object) -> None:
    with pytest.raises(InputError, match="settings"):
        write_container(tmp_path / "a.fgs", quantize_all(make_scene(3)), {"a": value})
    assert list(tmp_path.iterdir()) == []


def test_settings_are_canonical() -> None:
    assert canonical_json({"b": 1, "a": {"d": 0.1, "c": "é"}}) == b'{"a":{"c":"\\u00e9","d":0.1},"b":1}'
    assert header_block({}) == 2048


def test_no_overwrite_without_force(tmp_path: Path) -> None:
    path = tmp_path / "a.fgs"
    quantized = quantize_all(make_scene(3))
    write_container(path, quantized, {})
    before = path.read_bytes()
    with pytest.raises(InputError, match="exists"):
        write_container(path, quantized, {"a": 1})
    assert path.read_bytes() == before
    write_container(path, quantized, {"a": 1}, force=True)
    assert read_header(path).settings == {"a": 1}


def test_open_scene_reads_containers(tmp_path: Path) -> None:
    path = tmp_path / "a.FGS"
    write_container(path, quantize_all(make_scene(3)), {})
    assert isinstance(open_scene(path), FgsSource)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot read it"):
        read_header(tmp_path / "none.fgs")


@pytest.mark.parametrize("count", [0, 1, 40])
@pytest.mark.parametrize("bits", [PAPER, BitSpec(11, 5, 1, 9, 16, 3)])
def test_the_written_format_is_enough_to_decode(tmp_path: Path, count: int, bits: BitSpec) -> None:
    path = tmp_path / "a.fgs"
    quantized = quantize_all(make_scene(count, 2), bits, 3)
    write_container(path, quantized, {"a": [1, None]})
    header, values = educational_decoder.decode(path.read_bytes())
    assert header["settings"] == {"a": [1, None]}
    assert header["origin"] == [1234.5, -0.1, 1e-7]
    for name, array in quantized.arrays.items():
        assert values[name].tobytes() == dequantize(array, slice(None)).tobytes()


def regenerator() -> ModuleType:
    spec = importlib.util.spec_from_file_location("regenerate_v1", GOLDEN / "regenerate_v1.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_golden_bytes(tmp_path: Path) -> None:
    module = regenerator()
    module.main(tmp_path)
    golden = (GOLDEN / "v1" / "tiny.fgs").read_bytes()
    assert (tmp_path / "tiny.fgs").read_bytes() == golden
    header, values = educational_decoder.decode(golden)
    source = FgsSource(GOLDEN / "v1" / "tiny.fgs")
    with np.load(GOLDEN / "v1" / "tiny.npz") as expected:
        for name, plane in whole(source).items():
            assert plane.tobytes() == expected[name].tobytes()
            assert values[name].tobytes() == expected[name][:, : values[name].shape[1]].tobytes()
    assert header["count"] == 11 and header["sh_count"] == 5
    assert json.loads(json.dumps(source.settings)) == module.SETTINGS


def test_constants_of_the_format() -> None:
    assert layout.CHUNK_ROWS == 65536
    assert layout.sections.PREAMBLE_BYTES == 36
