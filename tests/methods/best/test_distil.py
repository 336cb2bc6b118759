"""The descent of all values towards the original's renders, its targets, and the search that ends with it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fits import use_fit
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.candidates import look
from flexgs_edge.cameras.directions import fibonacci
from flexgs_edge.cameras.generated import poses_between
from flexgs_edge.codec.v2.encode import encode_grid
from flexgs_edge.commands.compress import compress
from flexgs_edge.errors import BudgetError, InputError
from flexgs_edge.grid.grid_scene import from_grid
from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.grid.to_grid import to_grid
from flexgs_edge.io.ply import write_ply
from flexgs_edge.kernels.backend import TwinBackend
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.methods.best.refit.colour import refit_colours
from flexgs_edge.methods.best.refit.finetune import (
    FIELD_RATES,
    FULL_MARGIN,
    HELD,
    MARGIN_STRUCTURE,
    STRUCTURE,
    Schedule,
    finetune,
    structure_of,
)
from flexgs_edge.quality.similarity import ssims
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.view_set import GivenViews
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource
from flexgs_edge.views.references import Original, References
from kernel_fixtures import large_budget, open_form, same_bits
from synthetic import look_from, make_camera, make_splats, random_scene
from tiny_project import make_project

Planes = dict[str, np.ndarray]
KEPT = 150
SEEN = 6
STEPS = StepSizes(0.03, 0.25, 0.06, 0.5, 0.15, (0.12, 0.12))
DEPTH = 50.0
RATES = {"means": Schedule.means_rate * DEPTH, **FIELD_RATES}


def view(seed: int, width: int = 45, height: int = 37) -> Camera:
    rotation, translation = look_from(seed)
    return make_camera(width, height, rotation=rotation, translation=translation, name=f"v{seed}")


class Workshop:
    """A scene, the largest of its Gaussians, and poses to learn from."""

    def __init__(self, form: str = "w16") -> None:
        whole = random_scene(300, 71, 2, size=-1.8).read(slice(0, 300), list(FIELD))
        rank = np.argsort(-(whole["log_scales"].sum(axis=0) + whole["opacity_logits"][0]), kind="stable")
        self.kept = {name: np.ascontiguousarray(values[:, np.sort(rank[:KEPT])]) for name, values in whole.items()}
        self.degrees = np.arange(KEPT) % 3
        self.kept["sh_rest"] = self._without_higher(self.kept["sh_rest"])
        self.kept["means"][:, 0] = (0, 0, -50)  # behind every camera
        self.renderer = Renderer(open_form(form), large_budget())
        self.cameras = [view(seed) for seed in range(SEEN)]
        with self.renderer.load(MemorySource(whole)) as scene:
            self.references = References.of(self.renderer, scene, self.cameras)
            self.original = [self.renderer.render(scene, camera) for camera in self.cameras]

    def _without_higher(self, rest: np.ndarray) -> np.ndarray:
        planes = rest.reshape(3, 8, KEPT).copy()
        planes[:, :3] *= self.degrees >= 1
        planes[:, 3:] *= self.degrees >= 2
        return planes.reshape(24, KEPT)

    def fidelity(self, planes: Planes) -> float:
        """At the poses that it learns from: in a random cloud others tell nothing."""
        with self.renderer.load(MemorySource(planes)) as scene:
            images = [self.renderer.render(scene, camera) for camera in self.cameras]
        errors = [np.mean(np.square(a - b)) for a, b in zip(images, self.original, strict=True)]
        return float(-10 * np.log10(np.mean(errors)))

    def distil(self, steps: int, grid: StepSizes | None = None, **words: Any) -> Planes:
        structure = words.pop("structure", STRUCTURE)
        return finetune(self.kept, self.degrees, self.seen, Schedule(steps, **words), grid, structure)

    @property
    def seen(self) -> Original:
        return Original(self.renderer, np.zeros(3), self.cameras, self.references, depth=DEPTH)

    def rounded(self, planes: Planes) -> Planes:
        return from_grid(to_grid(planes, self.degrees, STEPS, np.zeros(3))[0])

    def close(self) -> None:
        self.references.close()
        self.renderer.release()


@pytest.fixture
def workshop() -> Iterator[Workshop]:
    made = Workshop()
    yield made
    made.close()


def test_a_descent_gets_closer_than_a_refit_of_colours(workshop: Workshop) -> None:
    refitted = refit_colours(workshop.kept, workshop.degrees, workshop.seen, rounds=4, subsets=2)
    before, refit, short, long = map(
        workshop.fidelity, (workshop.kept, refitted, workshop.distil(12), workshop.distil(360))
    )
    assert long > refit + 2 > before + 4 and long > short > before, (before, refit, short, long)


def test_positions_move_by_a_share_of_the_depth(workshop: Workshop) -> None:
    moves = []
    for depth in (0.5, 50.0):
        planes = finetune(workshop.kept, workshop.degrees, replace(workshop.seen, depth=depth), Schedule(4))
        moves.append(float(np.abs(planes["means"] - workshop.kept["means"]).max()))
    assert 0 < 20 * moves[0] < moves[1], moves


def test_structure_weighs_more_where_ssim_decides() -> None:
    assert (
        structure_of(0.0) == STRUCTURE < structure_of(FULL_MARGIN / 2) < structure_of(FULL_MARGIN) == MARGIN_STRUCTURE
    )
    assert structure_of(9.0) == MARGIN_STRUCTURE


def test_the_structural_term_keeps_structure(workshop: Workshop) -> None:
    """A large one wins SSIM, and costs squared error."""
    plain, structural = (workshop.distil(240, structure=weight) for weight in (0.0, 0.3))
    assert workshop.fidelity(structural) < workshop.fidelity(plain)
    found = []
    for planes in (plain, structural):
        with workshop.renderer.load(MemorySource(planes)) as scene:
            images = [workshop.renderer.render(scene, camera) for camera in workshop.cameras]
        found.append(np.mean(ssims(workshop.renderer.backend, list(zip(images, workshop.original, strict=True)))))
    assert found[1] > found[0] + 0.003, found


def test_rows_keep_their_places_and_degrees(workshop: Workshop) -> None:
    moved = workshop.distil(2)
    assert same_bits(moved["sh_rest"], workshop._without_higher(moved["sh_rest"]))
    for name in ("means", "log_scales", "opacity_logits", "sh_dc"):
        # Nobody sees it; and two steps take no value far from where it was.
        assert name == "log_scales" or same_bits(moved[name][:, :1], workshop.kept[name][:, :1])
        distance = abs(np.sort(moved[name], axis=0) - np.sort(workshop.kept[name], axis=0)).max()
        assert 0 < distance < 3 * RATES[name], name
    norms = np.square(moved["quats"]).sum(axis=0)
    assert abs(norms - 1).max() < 4 * RATES["quats"]


def test_steps_on_the_grid_repair_it(workshop: Workshop) -> None:
    blind, aware = workshop.distil(120), workshop.distil(180, STEPS)  # 120 of them before the grid
    assert workshop.fidelity(workshop.rounded(aware)) > workshop.fidelity(workshop.rounded(blind)) + 0.2


def test_bits_that_cost_are_saved(workshop: Workshop) -> None:
    """With a price on bits, the file is smaller and the error larger; without a grid there are no bits."""
    free, priced = (workshop.distil(180, STEPS, multiplier=price) for price in (0.0, 0.05))
    sizes = [
        len(b"".join(encode_grid(to_grid(planes, workshop.degrees, STEPS, np.zeros(3))[0]).streams()))
        for planes in (free, priced)
    ]
    assert sizes[1] < 0.97 * sizes[0], sizes
    assert workshop.fidelity(workshop.rounded(priced)) < workshop.fidelity(workshop.rounded(free))
    off, on = (workshop.distil(5, multiplier=price) for price in (0.0, 0.05))
    assert all(same_bits(off[name], on[name]) for name in off)


def test_every_run_and_width_gives_the_same_bits(workshop: Workshop) -> None:
    first = workshop.distil(5, STEPS, multiplier=0.05)
    for form in ("w16", "w4", "numpy"):
        other = Workshop(form)
        again = other.distil(5, STEPS, multiplier=0.05)
        other.close()
        assert all(same_bits(first[name], again[name]) for name in first), form


def test_each_view_comes_once_in_each_round() -> None:
    order = Schedule(23).order(7)
    assert len(order) == 23 and same_bits(order, Schedule(23).order(7))
    for start in (0, 7, 14):
        assert sorted(order[start : start + 7]) == list(range(7))
    assert not same_bits(order[:7], order[7:14])


def test_a_view_with_more_turns_comes_more_often() -> None:
    order = Schedule(40).order(4, np.array([4.0, 2.0, 1.0, 1.0]))
    assert np.bincount(order).tolist() == [20, 10, 5, 5]
    # What a round leaves over counts in the next: five steps for each two rounds of four.
    assert np.bincount(order[:8]).tolist() == [4, 2, 1, 1]
    assert len(Schedule(3).order(0)) == 0


def test_parts_of_a_descent(workshop: Workshop) -> None:
    assert [len(part) for part in Schedule(8).parts(True)] == [4, 2, 2]
    assert [len(part) for part in Schedule(8).parts(False)] == [8, 0, 0]
    moving, held = (
        workshop.distil(9, STEPS, on_grid=0.0, holding=1 / 3),
        workshop.distil(3, STEPS, on_grid=0.0, holding=1.0),
    )
    for name in moving:
        assert same_bits(moving[name], held[name]) == (name in HELD), name


def test_too_little_memory_is_said_and_leaves_nothing_taken(
    workshop: Workshop, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_fit(monkeypatch, pairs=1 << 10)
    use_fit(monkeypatch, least_rows=16)
    refused = []
    for limit in range(200_000, 4_000_000, 50_000):
        budget = MemoryBudget(limit)
        renderer = Renderer(TwinBackend(budget), budget)
        try:
            original = Original(renderer, np.zeros(3), workshop.cameras, workshop.references)
            finetune(workshop.kept, workshop.degrees, original, Schedule(1))
        except BudgetError as error:
            refused.append(str(error))
        else:
            break
        finally:
            renderer.release()
            assert budget.used == 0
    assert limit < 3_000_000 and all("--memory-limit" in words for words in refused)
    assert any("keeps all of them in memory at once" in words for words in refused)


def test_poses_between() -> None:
    apart = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (3.0, 0.0, 0.0)
    cameras = [make_camera(translation=place, name=str(k)) for k, place in enumerate(apart)]
    middles = poses_between(cameras)
    assert [camera.name for camera in middles] == ["0 to 1", "1 to 2"]
    np.testing.assert_allclose([camera.center for camera in middles], [(-0.5, 0, 0), (-2, 0, 0)], atol=1e-12)
    turned, around = np.diag([-1.0, 1, -1]), np.array([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]])
    assert poses_between([cameras[0], make_camera(rotation=turned, translation=(1.0, 0, 0))]) == []
    (middle,) = poses_between([cameras[0], make_camera(rotation=around, translation=(1.0, 0, 0))])
    np.testing.assert_allclose(middle.rotation @ middle.rotation.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(middle.rotation @ middle.rotation, around, atol=1e-12)
    assert poses_between(cameras[:1]) == poses_between([]) == poses_between([cameras[0], cameras[0]]) == []


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_project(tmp_path_factory.mktemp("tiny") / "scene")


def test_distilled_files_lose_less_in_the_same_bytes(sample_dir: Path, tmp_path: Path) -> None:
    """In views that are held out, and in the same bytes each time."""
    words: dict[str, Any] = {
        "effort": "fast",
        "promise": "mean",
        "images": "none",
        "resolution": 160,
        "max_size": 60_000,
    }
    plain = compress(sample_dir / "point_cloud.ply", tmp_path / "plain.fgs", distil=0, **words)
    found, again = (
        compress(sample_dir / "point_cloud.ply", tmp_path / name, distil=120, **words) for name in ("a.fgs", "b.fgs")
    )
    assert found.size <= 60_000 and found.size <= 1.02 * plain.size
    assert found.quality is not None and plain.quality is not None
    assert found.quality.fidelity is not None and plain.quality.fidelity is not None
    # 4.5 dB; it was 5.1 in 40 kB, and 3.8 in 90.
    assert found.quality.fidelity > plain.quality.fidelity + 2.0
    assert again.quality == found.quality
    assert (tmp_path / "a.fgs").read_bytes() == (tmp_path / "b.fgs").read_bytes()


def test_a_size_that_has_room_for_all_is_not_pruned_for_a_descent(tmp_path: Path) -> None:
    """A surface without a Gaussian to spare: each that goes leaves a hole."""
    points = np.array(fibonacci(400))
    write_ply(tmp_path / "lone.ply", make_splats(points, np.full((400, 3), 0.06), colours=abs(points)))
    cameras = [
        look(str(k), -4 * line, line, np.array([0.1, 1, 0.2]), 80, 80, 120.0) for k, line in enumerate(fibonacci(24))
    ]
    words: dict[str, Any] = {"effort": "fast", "max_size": 5000, "dry_run": True}
    plain, found = (
        compress(tmp_path / "lone.ply", None, given=GivenViews(cameras), distil=n, **words) for n in (0, 40)
    )
    assert plain.quality is not None and found.quality is not None and found.search is not None
    assert (found.quality.fidelity or 0.0) > (plain.quality.fidelity or 0.0) - 0.2
    assert found.size <= 5000 and len(found.search.steps) <= 6


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"distil": 10, "method": "paper"}, "--distil belongs to --method best"),
        ({"distil": -1}, "--distil -1: expected 0"),
        ({"distil": 10, "refit": False}, "--no-refit with --distil 10"),
    ],
)
def test_words_that_make_no_sense(words: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        CompressOptions(**words)


def test_files_of_other_formats_are_fine_tuned_too(project: Path, tmp_path: Path) -> None:
    # The size has room for all rows: between files of fewer, other rows would make the difference.
    words: dict[str, Any] = {"effort": "fast", "promise": "mean", "max_size": 12_000}
    plain, tuned = (compress(project / "point_cloud.ply", tmp_path / f"{n}.spz", distil=n, **words) for n in (0, 40))
    assert plain.training_fidelity is not None and tuned.training_fidelity is not None
    assert tuned.training_fidelity > plain.training_fidelity
