"""Sources: memory, selections, and what `read` accepts."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexgs_edge.errors import InputError
from flexgs_edge.scene.fields import FIELD, FIELDS
from flexgs_edge.scene.source import MemorySource, SelectSource

ALL = [field.name for field in FIELDS]


def arrays(count: int, degree: int = 1, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {f.name: rng.normal(size=(f.width(degree), count)).astype(np.float32) for f in FIELDS}


@pytest.mark.parametrize("count", [0, 1, 7])
@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_memory_source_gives_back_its_arrays(count: int, degree: int) -> None:
    data = arrays(count, degree)
    source = MemorySource(data)
    assert (source.count, source.sh_degree, source.sh_count) == (count, degree, count if degree else 0)
    read = source.read(slice(0, count), ALL)
    assert list(read) == ALL
    for name in ALL:
        assert read[name].dtype == np.float32
        np.testing.assert_array_equal(read[name], data[name])


def test_memory_source_neither_copies_nor_hands_out_its_arrays() -> None:
    data = arrays(4)
    source = MemorySource(data)
    data["means"][0, 0] = 77.0
    read = source.read(slice(0, 4), ["means"])["means"]
    assert read[0, 0] == 77.0
    read[...] = 0.0
    assert data["means"][0, 0] == 77.0


def test_sh_rest_may_be_missing_at_degree_0() -> None:
    data = arrays(3, 0)
    del data["sh_rest"]
    assert MemorySource(data).read(slice(0, 3), ["sh_rest"])["sh_rest"].shape == (0, 3)


@pytest.mark.parametrize(
    ("change", "kwargs", "words"),
    [
        ({"quats": None}, {}, "missing fields quats"),
        ({"colour": np.zeros((3, 5))}, {}, "unknown fields colour"),
        ({"quats": np.zeros((3, 5))}, {}, r"quats: expected an array \(4, 5\), found \(3, 5\)"),
        ({"quats": np.zeros((4, 6))}, {}, r"quats: expected an array \(4, 5\)"),
        ({"sh_rest": np.zeros((10, 5))}, {}, "sh_rest has 10 channels; expected one of 0, 9, 24, 45, 72"),
        ({}, {"sh_degree": 2}, r"sh_rest: expected an array \(24, 5\)"),
        ({}, {"sh_degree": 5}, "SH degree 5: expected 0 to 4"),
        ({}, {"sh_count": 2}, "rows from sh_count 2 on must be zeros"),
        ({}, {"sh_count": 6}, "sh_count 6: expected 0 to 5"),
        ({}, {"origin": [0.0, np.nan, 0.0]}, "origin"),
        ({}, {"origin": [0.0, 0.0]}, "origin"),
    ],
)
def test_memory_source_refuses(change: dict[str, np.ndarray | None], kwargs: dict[str, int], words: str) -> None:
    data = {name: value for name, value in {**arrays(5), **change}.items() if value is not None}
    with pytest.raises(InputError, match=words):
        MemorySource(data, **kwargs)  # type: ignore[arg-type]


def test_read_fills_the_callers_arrays() -> None:
    source = MemorySource(arrays(6))
    big = np.full((3, 10), -1.0, np.float32)
    out = {"means": big[:, 2:5]}
    read = source.read(slice(1, 4), ["means", "quats"], out)
    assert read["means"] is out["means"]
    np.testing.assert_array_equal(big[:, 2:5], source.read(slice(1, 4), ["means"])["means"])
    assert (big[:, :2] == -1).all() and (big[:, 5:] == -1).all()
    assert "quats" not in out


@pytest.mark.parametrize(
    ("rows", "error"),
    [
        (slice(0, 7), IndexError),
        (slice(-2, 3), IndexError),
        (slice(4, 2), IndexError),
        (slice(0, 4, 2), IndexError),
        (np.array([0, 6]), IndexError),
        (np.array([-1, 2]), IndexError),
        (np.array([True, False, True, False, True, True]), IndexError),
        (np.array([0.0, 1.0]), IndexError),
        (np.array([[0, 1]]), IndexError),
    ],
)
def test_read_refuses_rows_outside(rows: slice | np.ndarray, error: type[Exception]) -> None:
    with pytest.raises(error, match="rows"):
        MemorySource(arrays(6)).read(rows, ["means"])


def test_read_refuses_unknown_fields_and_wrong_arrays() -> None:
    source = MemorySource(arrays(6))
    with pytest.raises(ValueError, match="field 'colour': expected one of means"):
        source.read(slice(0, 1), ["colour"])
    with pytest.raises(ValueError, match=r"out\['means'\]: expected \(3, 2\) float32, found \(3, 3\)"):
        source.read(slice(0, 2), ["means"], {"means": np.empty((3, 3), np.float32)})
    with pytest.raises(ValueError, match=r"found .* float64"):
        source.read(slice(0, 2), ["means"], {"means": np.empty((3, 2))})


def test_chunks_cover_the_scene_in_order() -> None:
    source = MemorySource(arrays(7))
    assert list(source.chunks(3)) == [slice(0, 3), slice(3, 6), slice(6, 7)]
    assert list(MemorySource(arrays(0)).chunks(3)) == []
    with pytest.raises(ValueError, match="at least 1"):
        list(source.chunks(0))


@given(st.data())
def test_selections_compose_like_fancy_indexing(data: st.DataObject) -> None:
    count = data.draw(st.integers(1, 12))
    values = arrays(count, 1, seed=count)
    sh_count = data.draw(st.integers(0, count))
    values["sh_rest"][:, sh_count:] = 0.0
    source = MemorySource(values, sh_count=sh_count, origin=[1.0, 2.0, 3.0])
    first = np.array(data.draw(st.lists(st.integers(0, count - 1), max_size=15)), np.int64)
    chosen = source.select(first)
    assert isinstance(chosen, SelectSource)
    picks = st.lists(st.integers(0, max(len(first) - 1, 0)), max_size=15 if len(first) else 0)
    second = np.array(data.draw(picks), np.int64)
    nested = chosen.select(second)
    assert isinstance(nested, SelectSource) and nested.parent is source
    np.testing.assert_array_equal(nested.origin, source.origin)
    for view, rows in ((chosen, first), (nested, first[second])):
        read = view.read(slice(0, view.count), ALL)
        for name in ALL:
            np.testing.assert_array_equal(read[name], values[name][:, rows])
        assert not read["sh_rest"][:, view.sh_count :].any()
        assert view.sh_count == 0 or rows[view.sh_count - 1] < sh_count


def test_a_selection_reads_its_parent_in_sorted_order() -> None:
    seen: list[slice | np.ndarray] = []

    class Spy(MemorySource):
        def read(self, rows, fields, out=None):  # type: ignore[no-untyped-def]
            seen.append(rows)
            return super().read(rows, fields, out)

    source = Spy(arrays(9))
    source.select(np.array([3, 4, 5])).read(slice(0, 3), ["means"])
    assert seen.pop() == slice(3, 6)
    source.select(np.array([8, 1, 4])).read(slice(0, 3), ["means"])
    np.testing.assert_array_equal(seen.pop(), [1, 4, 8])
    source.select(np.array([1, 4, 8])).read(np.array([0, 2]), ["means"])
    np.testing.assert_array_equal(seen.pop(), [1, 8])


def test_a_selection_of_rows_outside_is_refused_at_once() -> None:
    with pytest.raises(IndexError):
        MemorySource(arrays(3)).select(np.array([3]))


def test_widths_follow_the_degree() -> None:
    assert [FIELD["sh_rest"].width(d) for d in range(5)] == [0, 9, 24, 45, 72]
    assert MemorySource(arrays(1, 2)).width("sh_rest") == 24
