"""Rounds that a run leaves on disk: what comes back, and what is computed anew."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

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


@pytest.mark.parametrize("file", ["rows.npy", "plane-means.npy", "done"])
def test_a_damaged_round_is_computed_anew(tmp_path: Path, caplog: pytest.LogCaptureFixture, file: str) -> None:
    arrays: list[tuple[str, np.ndarray]] = [("rows", np.arange(7)), ("plane-means", np.ones((3, 7), np.float32))]
    for number, damage in enumerate((b"", b"cut", b"flipped", None)):
        checkpoint = Checkpoint(tmp_path / str(number))
        checkpoint.save(0, arrays)
        checkpoint.save(1, arrays)
        place = checkpoint.folder / "round-1" / file
        whole = place.read_bytes()
        changed = {b"": b"", b"cut": whole[:-1], b"flipped": whole[:-3] + bytes([whole[-3] ^ 4]) + whole[-2:]}
        if damage is None:
            place.unlink()
        else:
            place.write_bytes(changed[damage])
        again = Checkpoint(checkpoint.folder)
        assert again.has(0) and not again.has(1) and again.rounds == 1
        if file != "done" or damage is not None:  # A round without it was cut short, which is no damage.
            assert f"{place.parent}" in caplog.text and "is damaged: that round" in caplog.text
            assert not place.parent.exists()
        again.save(1, arrays)
        assert Checkpoint(checkpoint.folder).rounds == 2
