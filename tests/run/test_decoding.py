"""Where a file's scene is decoded, and how often."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flexgs_edge.codec.v2.container import write_grid
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.commands import decompress as command
from flexgs_edge.commands.decompress import decompress
from flexgs_edge.errors import BudgetError
from flexgs_edge.io.reading import Writing
from flexgs_edge.kernels.tested import open_backend
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.memory.process import current_rss
from flexgs_edge.progress import Stopwatch
from flexgs_edge.run.decoding import decode_bytes, decoded_once, decoder, read_often
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource
from grid_scenes import make_grid

COUNT = 3000


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("decoding") / "scene.fgs"
    write_grid(place, make_grid(COUNT, layers=2), {})
    return place


def test_a_scene_is_decoded_to_memory_where_it_fits(file: Path) -> None:
    source, rows = GridSource(file), slice(0, COUNT)
    once = decoded_once(source, MemoryBudget(1 << 30), 0, None)
    assert isinstance(once, MemorySource)
    assert decoded_once(once, MemoryBudget(1 << 30), 0, None) is once
    for name, values in source.read(rows, list(FIELD)).items():
        np.testing.assert_array_equal(once.read(rows, [name])[name], values)
    assert decoded_once(source, MemoryBudget(1 << 30), 1 << 30, None) is source


def test_a_scene_that_does_not_fit_decoded_has_room_for_its_decoding(file: Path) -> None:
    source, budget = GridSource(file), MemoryBudget(1 << 30)
    backend = open_backend("numpy", budget)
    once = read_often(source, MemoryBudget(1 << 30), 0, backend)
    assert isinstance(once, MemorySource)
    assert read_often(source, budget, 1 << 30, backend) is source
    assert budget.used == decode_bytes(source, None) > source.table_bytes > 0
    assert read_often(once, budget, 1 << 30, backend) is once
    assert budget.used == decode_bytes(source, None)


@pytest.mark.parametrize("suffix", [".spz", ".sog", ".glb", ".compressed.ply", ".splat"])
def test_other_formats_have_the_same_bytes_either_way(
    suffix: str, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decompress(file, tmp_path / f"once{suffix}", writing=Writing(force_lossy=True), cameras="none")
    monkeypatch.setattr(command, "decoded_once", lambda source, *_: source)
    decompress(file, tmp_path / f"again{suffix}", writing=Writing(force_lossy=True), cameras="none")
    assert (tmp_path / f"once{suffix}").read_bytes() == (tmp_path / f"again{suffix}").read_bytes()


def test_a_runtime_that_does_not_fit_decodes_nothing(file: Path) -> None:
    """Unless it was asked for by name, NumPy decodes then."""
    source, small = GridSource(file), MemoryBudget(64 << 20)
    assert decoder(None, source, small, Stopwatch(), least=0) is None
    assert decoder(None, source, MemoryBudget(1 << 40), Stopwatch(), least=0) is not None


def test_too_little_memory_to_decode_is_an_error(file: Path, tmp_path: Path) -> None:
    with pytest.raises(BudgetError, match="decoding needs"):
        decompress(file, tmp_path / "scene.ply", memory_limit=current_rss() + (1 << 20))
    assert decode_bytes(GridSource(file), None) > 100 * COUNT
    assert not (tmp_path / "scene.ply").exists()
