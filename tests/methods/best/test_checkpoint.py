"""Rounds that a run leaves on disk: what comes back, and what is refused."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from flexgs_edge.errors import InputError
from flexgs_edge.memory.storage import IN_MEMORY
from flexgs_edge.methods.best.checkpoint import Checkpoint


def test_rounds_come_back(tmp_path: Path) -> None:
    checkpoint = Checkpoint(tmp_path / "rounds")
    means = np.random.default_rng(0).normal(size=(3, 7)).astype(np.float32)
    arrays: dict[str, np.ndarray] = {"rows": np.arange(7), "plane-means": means, "none": np.zeros((0, 7))}
    checkpoint.save(0, arrays.items())
    assert checkpoint.has(0) and not checkpoint.has(1) and checkpoint.rounds == 1
    found = checkpoint.load(0, IN_MEMORY)
    assert found.keys() == arrays.keys()
    for name, values in arrays.items():
        assert found[name].dtype == values.dtype and np.array_equal(found[name], values)


def test_damaged_files_are_named(tmp_path: Path) -> None:
    """Somebody else may write to the folder, too: arrays that would run code are refused."""
    checkpoint = Checkpoint(tmp_path / "rounds")
    checkpoint.save(0, [("rows", np.arange(7))])
    (place,) = checkpoint.folder.rglob("rows.npy")
    whole = place.read_bytes()
    for damage in (b"", whole[:100], whole[:-1], pickle.dumps({})):
        place.write_bytes(damage)
        with pytest.raises(InputError, match=f"{place}: expected an array .*; delete {checkpoint.folder} to begin"):
            checkpoint.load(0, IN_MEMORY)
    np.save(place, np.array([{"code": 1}], object), allow_pickle=True)
    with pytest.raises(InputError, match="expected an array"):
        checkpoint.load(0, IN_MEMORY)
