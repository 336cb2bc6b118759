"""Rounds of pruning: what they keep, and what they make again."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from flexgs_edge.memory.storage import IN_MEMORY, ScratchStorage, Storage
from flexgs_edge.methods.best.costs import Snapshot
from flexgs_edge.methods.best.rounds import SNAPSHOTS_HELD, PruneRounds, take_rows
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.views.references import Original, References
from kernel_fixtures import large_budget, open_form
from synthetic import look_from, make_camera, random_scene

SCENE = random_scene(120, 5, 1)
CAMERAS = [
    make_camera(12, 10, rotation=rotation, translation=translation, name=f"v{seed}")
    for seed, (rotation, translation) in enumerate(map(look_from, range(12)))
]


@contextmanager
def open_rounds(storage: Storage, refit: bool = True) -> Iterator[PruneRounds]:
    renderer = Renderer(open_form("w16"), large_budget())
    renderer.storage = storage
    with References() as references:
        original = Original(renderer, SCENE.origin, CAMERAS, references)
        yield PruneRounds(original, SCENE, refit=refit)
    renderer.release()


def prune(rounds: PruneRounds) -> list[Snapshot]:
    """Rounds with what looks like a descent between them."""

    def change() -> tuple[np.ndarray, dict[str, np.ndarray]]:
        last = rounds.snapshots[-1]
        return last.rows[1:], {name: values[:, 1:] * np.float32(0.99) for name, values in last.planes.items()}

    for _ in range(3):
        rounds.descend(0.8)
    rounds.renew(change)
    for _ in range(4):
        rounds.descend(0.8)
    return rounds.snapshots


def test_planes_in_files_are_let_go_and_made_again_with_the_same_bits(compact: None, tmp_path: Path) -> None:
    for refit in (True, False):
        with open_rounds(IN_MEMORY, refit) as expected, open_rounds(ScratchStorage(tmp_path, least=0), refit) as rounds:
            found = prune(rounds)
            held = [snapshot.held for snapshot in found]
            # That of the descent, and the last ones.
            assert held == [number == 4 or number >= len(held) - SNAPSHOTS_HELD for number in range(len(held))]
            for number, (one, other) in enumerate(zip(found, prune(expected), strict=True)):
                np.testing.assert_array_equal(one.rows, other.rows)
                np.testing.assert_array_equal(one.costs.removal, other.costs.removal)
                for name, values in other.planes.items():
                    np.testing.assert_array_equal(one.planes[name], values, err_msg=f"{number} {name}")
            rounds.let_go()
            expected.let_go()
            assert [snapshot.held for snapshot in found] == [number == 4 for number in range(len(held))]
            assert all(snapshot.held for snapshot in expected.snapshots)
            np.testing.assert_array_equal(found[3].planes["sh_dc"], expected.snapshots[3].planes["sh_dc"])


@pytest.mark.parametrize("spills", [False, True])
def test_a_round_that_is_undone_leaves_those_before_it(compact: None, tmp_path: Path, spills: bool) -> None:
    storage = ScratchStorage(tmp_path, least=0) if spills else IN_MEMORY
    with open_rounds(storage) as rounds:
        first, second = rounds.descend(0.8), rounds.descend(0.8)
        planes = {name: values.copy() for name, values in second.planes.items()}
        rounds.renew(lambda: (first.rows[::2], take_rows(first.planes, np.arange(0, first.count, 2), storage)))
        rounds.undo()
        assert len(rounds.snapshots) == 3
        for name, values in planes.items():
            np.testing.assert_array_equal(rounds.snapshots[2].planes[name], values, err_msg=name)
        np.testing.assert_array_equal(rounds.snapshots[2].rows, second.rows)
        assert rounds.descend(0.5).count == second.count // 2


def test_rounds_that_have_ended_keep_no_files(compact: None, tmp_path: Path) -> None:
    storage = ScratchStorage(tmp_path, least=0)
    gc.collect()
    gc.disable()
    try:
        with open_rounds(storage) as rounds:
            prune(rounds)
            assert storage.used > 0
            del rounds
    finally:
        gc.enable()
    assert storage.used == 0


def test_a_round_changes_colours_and_nothing_else() -> None:
    with open_rounds(IN_MEMORY) as rounds:
        first, second = rounds.snapshots[0], rounds.descend(0.5)
        assert second.count == first.count // 2
        moved = [name for name in FIELD if not np.array_equal(second.planes[name], first.planes[name][:, second.rows])]
        assert moved == ["sh_dc", "sh_rest"]
