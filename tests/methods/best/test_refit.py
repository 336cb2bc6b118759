"""The colour refit against the original's renders, and the renders that it is given."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from benchmarks.harness import read_sums
from fits import use_fit
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.constants import FIXED_ERROR, SH_C0
from flexgs_edge.methods.best.refit.colour import refit_colours, step_colours
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.render.statistics import Statistics
from flexgs_edge.scene.fields import FIELD, sh_rest_count
from flexgs_edge.scene.source import MemorySource
from flexgs_edge.views.references import Original, References
from kernel_fixtures import large_budget, open_form, same_bits
from synthetic import look_from, make_camera, random_scene

COUNT = 120
Planes = dict[str, np.ndarray]
OPENED: list[References] = []


@pytest.fixture(autouse=True)
def _closed_references() -> Iterator[None]:
    yield
    while OPENED:
        OPENED.pop().close()


def poses(views: int, width: int = 45, height: int = 37) -> list[Camera]:
    cameras = []
    for seed in range(views):
        rotation, translation = look_from(seed)
        cameras.append(make_camera(width, height, rotation=rotation, translation=translation))
    return cameras


def bright_planes(degree: int, count: int = COUNT, seed: int = 51) -> Planes:
    """A scene whose colours stay away from zero, where the renderer cuts them off."""
    planes = random_scene(count, seed, degree, size=-1.6).read(slice(0, count), list(FIELD))
    planes["sh_dc"] = np.abs(planes["sh_dc"]) + np.float32(1)
    planes["sh_rest"] *= np.float32(0.4)
    return planes


def perturbed(planes: Planes, seed: int = 52) -> Planes:
    rng = np.random.default_rng(seed)
    return {
        **planes,
        "sh_dc": planes["sh_dc"] + rng.normal(0, 0.3, planes["sh_dc"].shape).astype(np.float32),
        "sh_rest": planes["sh_rest"] + rng.normal(0, 0.15, planes["sh_rest"].shape).astype(np.float32),
    }


class Workshop:
    """A renderer, poses and the original's renders."""

    def __init__(self, planes: Planes, views: int = 6, form: str = "w16") -> None:
        self.renderer, self.cameras = Renderer(open_form(form), large_budget()), poses(views)
        self.original = self.images(planes)
        with self.renderer.load(MemorySource(planes)) as scene:
            self.references = References.of(self.renderer, scene, self.cameras)
        OPENED.append(self.references)

    def images(self, planes: Planes) -> list[np.ndarray]:
        with self.renderer.load(MemorySource(planes)) as scene:
            return [self.renderer.render(scene, camera).astype(np.float64) for camera in self.cameras]

    def error(self, planes: Planes) -> float:
        """Mean squared error against the original over all poses."""
        return float(np.mean([np.mean((a - b) ** 2) for a, b in zip(self.images(planes), self.original, strict=True)]))

    def fidelity(self, planes: Planes) -> float:
        return -10 * np.log10(self.error(planes))

    def refit(
        self, planes: Planes, degrees: np.ndarray | int, rounds: int, bands: bool = True, subsets: int = 1
    ) -> Planes:
        count = planes["means"].shape[1]
        degrees = np.broadcast_to(np.asarray(degrees, np.uint8), count)
        original = Original(self.renderer, np.zeros(3), self.cameras, self.references)
        return refit_colours(planes, degrees, original, rounds, bands, subsets)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_every_round_gets_closer(degree: int) -> None:
    planes = bright_planes(degree)
    workshop = Workshop(planes)
    wrong = perturbed(planes)
    fidelity = [workshop.fidelity(workshop.refit(wrong, degree, rounds)) for rounds in range(5)]
    assert (np.diff(fidelity) > 0.1).all(), fidelity
    assert fidelity[-1] > fidelity[0] + (5 if degree == 0 else 3), fidelity


def test_steps_after_parts_of_the_poses_get_closer_than_one_after_all() -> None:
    planes = bright_planes(1)
    workshop = Workshop(planes)
    wrong = perturbed(planes)
    one, three = workshop.refit(wrong, 1, 1), workshop.refit(wrong, 1, 1, subsets=3)
    assert workshop.fidelity(three) > workshop.fidelity(one) + 0.5
    most = workshop.refit(wrong, 1, 1, subsets=len(workshop.cameras))
    assert same_bits(workshop.refit(wrong, 1, 1, subsets=99)["sh_dc"], most["sh_dc"])


def test_the_constant_alone_gets_closer_too() -> None:
    planes = bright_planes(2)
    workshop = Workshop(planes)
    wrong = perturbed(planes)
    once, twice = (workshop.refit(wrong, 2, rounds, bands=False) for rounds in (1, 2))
    assert same_bits(once["sh_rest"], wrong["sh_rest"]) and not same_bits(once["sh_dc"], wrong["sh_dc"])
    assert workshop.fidelity(twice) > workshop.fidelity(once) + 0.1 > workshop.fidelity(wrong) + 1


def test_a_lone_splat_comes_back_by_the_same_share_each_round() -> None:
    """SIRT of one unknown: the error shrinks by 1 - sum(w^2) / sum(w), known from the weights."""
    planes = bright_planes(0, 1)
    workshop = Workshop(planes)
    wrong = {**planes, "sh_dc": planes["sh_dc"] + np.array([[0.3], [-0.2], [0.1]], np.float32)}
    left = [workshop.refit(wrong, 0, rounds)["sh_dc"] - planes["sh_dc"] for rounds in range(4)]
    weight = weight2 = 0.0
    with workshop.renderer.load(MemorySource(planes)) as scene:
        statistics = Statistics.zeros(1)
        for camera in workshop.cameras:
            workshop.renderer.add_statistics(scene, camera, statistics)
            sums = read_sums(workshop.renderer, workshop.renderer.removal_sums(scene, camera), 2, 1)
            weight2 += sums[1, 0] / FIXED_ERROR
        weight = statistics.weight_sums[0]
    for before, after in zip(left, left[1:]):
        np.testing.assert_allclose(after, before * (1 - weight2 / weight), atol=1e-3)


@pytest.mark.parametrize("degree", [0, 2])
def test_nothing_moves_at_the_optimum(degree: int) -> None:
    planes = bright_planes(degree)
    workshop = Workshop(planes)
    again = workshop.refit(planes, degree, 3)
    # The references are in half precision: 2^-11 of a colour near 1.
    assert np.abs(again["sh_dc"] - planes["sh_dc"]).max() < 5e-3
    assert np.abs(again["sh_rest"] - planes["sh_rest"]).max(initial=0) < 5e-3
    assert workshop.fidelity(again) > 65


def test_what_is_given_is_not_changed() -> None:
    planes = perturbed(bright_planes(1))
    copies = {name: values.copy() for name, values in planes.items()}
    workshop = Workshop(bright_planes(1))
    found = workshop.refit(planes, 1, 2)
    assert all(same_bits(planes[name], copies[name]) for name in planes)
    assert all(found[name] is planes[name] for name in ("means", "log_scales", "quats", "opacity_logits"))
    nothing = workshop.refit(planes, 1, 0)
    assert same_bits(nothing["sh_dc"], planes["sh_dc"]) and same_bits(nothing["sh_rest"], planes["sh_rest"])


def test_faint_rows_move_as_far_as_others() -> None:
    """By the residual over the weight, however small that is; rows without weight stay."""
    sums = np.array([[[3.0, 0.003, 1.0], [0, 0, 1], [0, 0, 1], [30.0, 0.03, 0.0]]], np.float32)
    planes = {"sh_dc": np.zeros((3, 4), np.float32), "sh_rest": np.zeros((0, 4), np.float32)}
    step_colours(planes, np.zeros(4, np.uint8), slice(1, 4), sums)
    step = 0.1 / SH_C0
    assert planes["sh_dc"][0].tolist() == pytest.approx([0, step, step, 0]) and not planes["sh_dc"][1:].any()


def test_unseen_rows_are_left_alone() -> None:
    planes = bright_planes(1)
    unseen = [3, 50, COUNT - 1]
    planes["means"][:, unseen] = [[900.0], [0.0], [-50.0]]
    workshop = Workshop(planes)
    wrong = perturbed(planes)
    found = workshop.refit(wrong, 1, 3)
    for name in ("sh_dc", "sh_rest"):
        assert same_bits(found[name][:, unseen], wrong[name][:, unseen])
        assert (found[name] != wrong[name]).any(axis=0).sum() > COUNT // 2
        assert np.isfinite(found[name]).all()


def test_each_row_keeps_its_degree() -> None:
    planes = bright_planes(3)
    workshop = Workshop(planes)
    degrees = np.random.default_rng(53).integers(0, 4, COUNT).astype(np.uint8)
    bare = {**planes, "sh_rest": planes["sh_rest"].reshape(3, 15, COUNT).copy()}
    bands = np.array([1] * 3 + [2] * 5 + [3] * 7)
    bare["sh_rest"] *= degrees >= bands[:, None]
    bare["sh_rest"] = bare["sh_rest"].reshape(45, COUNT)
    found = workshop.refit(bare, degrees, 3)
    rest = found["sh_rest"].reshape(3, 15, COUNT)
    assert (rest[:, degrees < bands[:, None]] == 0).all()
    moved = (found["sh_rest"] != bare["sh_rest"]).reshape(3, 15, COUNT).any(axis=0)
    for degree in (1, 2, 3):
        band = moved[sh_rest_count(degree - 1) : sh_rest_count(degree)]
        assert band[:, degrees >= degree].mean() > 0.5 and not band[:, degrees < degree].any()
    assert workshop.fidelity(found) > workshop.fidelity(bare) + 0.5


def test_the_same_bits_every_time_on_every_form(monkeypatch: pytest.MonkeyPatch) -> None:
    use_fit(monkeypatch, pairs=1 << 14)
    planes, found = bright_planes(2, 60), []
    for form in ("w16", "w16", "w4", "gpu", "numpy"):
        found.append(Workshop(planes, 2, form).refit(perturbed(planes), 2, 2))
    for other in found[1:]:
        assert same_bits(other["sh_dc"], found[0]["sh_dc"]) and same_bits(other["sh_rest"], found[0]["sh_rest"])


@pytest.mark.parametrize("rows", [7, 64])
def test_chunks_and_batches_change_nothing(rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
    planes = bright_planes(1, 128)
    expected = Workshop(planes, 2).refit(perturbed(planes), 1, 2)
    use_fit(monkeypatch, chunk_rows=rows)
    use_fit(monkeypatch, pairs=1)
    found = Workshop(planes, 2).refit(perturbed(planes), 1, 2)
    assert same_bits(found["sh_dc"], expected["sh_dc"]) and same_bits(found["sh_rest"], expected["sh_rest"])


def test_a_scene_that_is_streamed_is_refitted_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    planes = bright_planes(1, 300)
    expected = Workshop(planes, 2).refit(perturbed(planes), 1, 2)
    use_fit(monkeypatch, resident=False, chunk_rows=128, least_rows=128)
    found = Workshop(planes, 2).refit(perturbed(planes), 1, 2)
    assert same_bits(found["sh_dc"], expected["sh_dc"]) and same_bits(found["sh_rest"], expected["sh_rest"])


@pytest.mark.parametrize("count", [0, 1])
def test_few_rows(count: int) -> None:
    planes = bright_planes(1, count)
    workshop = Workshop(planes, 2)
    found = workshop.refit(planes, 1, 2)
    assert found["sh_dc"].shape == (3, count) and found["sh_rest"].shape == (9, count)


def test_references_are_the_renders_in_half_precision(tmp_path: Path) -> None:
    planes = bright_planes(1)
    renderer, cameras = Renderer(open_form("w16"), large_budget(), background=(0.2, 0.4, 0.6)), poses(2)
    cameras += [make_camera(17, 33), make_camera(64, 16)]
    with renderer.load(MemorySource(planes)) as scene:
        with References.of(renderer, scene, cameras, tmp_path) as references:
            for view in (3, 0, 2, 1, 0):
                camera, target = cameras[view], references[view]
                assert target.dtype == np.float16 and target.shape[0] == 3
                assert target.shape[1] % 16 == target.shape[2] % 16 == 0
                image = renderer.render(scene, camera).transpose(2, 0, 1)
                assert same_bits(target[:, : camera.height, : camera.width], image.astype(np.float16))
        assert references._file.closed
        with pytest.raises(ValueError, match="closed"):
            _ = references[0]
    assert list(tmp_path.iterdir()) == []


class Interrupted(Renderer):
    """A renderer that is stopped when it comes to this view, if any."""

    at: Camera | None = None

    def render_planes(self, scene: DeviceScene, camera: Camera) -> np.ndarray:
        if camera is self.at:
            raise KeyboardInterrupt
        return super().render_planes(scene, camera)


def open_files(folder: Path) -> int:
    """Files of this process that lie in the folder, also those without a name."""
    links = []
    for link in Path("/proc/self/fd").iterdir():
        with suppress(FileNotFoundError):  # another thread, or the listing itself, may close a file meanwhile
            links.append(link.readlink())
    return sum(link.is_relative_to(folder.resolve()) for link in links)


def test_the_scratch_file_goes_when_something_fails(tmp_path: Path) -> None:
    renderer, cameras = Interrupted(open_form("w16"), large_budget()), poses(3)
    with renderer.load(MemorySource(bright_planes(0))) as scene:
        renderer.at = cameras[2]
        with pytest.raises(KeyboardInterrupt):
            References.of(renderer, scene, cameras, tmp_path)
        assert open_files(tmp_path) == 0
        renderer.at = None
        with pytest.raises(ZeroDivisionError), References.of(renderer, scene, cameras, tmp_path):
            assert open_files(tmp_path) == 1
            raise ZeroDivisionError
    assert open_files(tmp_path) == 0
    assert list(tmp_path.iterdir()) == []
