"""The check before work starts: every kind of bad value, one at a time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flexgs_edge.errors import InputError
from flexgs_edge.io.ply import PlySource
from flexgs_edge.memory.rows import BLOCK_ROWS
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.check import MOST_ALIKE, check_scene, without_hidden
from flexgs_edge.scene.fields import FIELDS
from flexgs_edge.scene.source import MemorySource
from kernel_fixtures import large_budget, open_form
from synthetic import make_camera

ALL = [field.name for field in FIELDS]


VALID = (("log_scales", -np.inf), ("opacity_logits", np.inf), ("opacity_logits", -np.inf))
"""Flat splats, and opacities 1 and 0."""


def arrays(count: int = 11, degree: int = 1) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(5)
    return {f.name: rng.normal(size=(f.width(degree), count)).astype(np.float32) for f in FIELDS}


@pytest.mark.parametrize("chunk_rows", [1, 4, 11, 100])
def test_a_good_scene_comes_back_as_it_is(chunk_rows: int) -> None:
    source = MemorySource(arrays())
    assert check_scene(source, chunk_rows=chunk_rows) is source


def test_an_empty_scene_is_refused() -> None:
    with pytest.raises(InputError, match="memory: the scene is empty"):
        check_scene(MemorySource(arrays(0)))


@pytest.mark.parametrize(
    ("field", "value"), [(f, v) for f in ALL for v in (np.nan, np.inf, -np.inf) if (f, v) not in VALID]
)
@pytest.mark.parametrize("chunk_rows", [3, 64])
def test_a_bad_value_is_named_and_can_be_dropped(field: str, value: float, chunk_rows: int) -> None:
    data = arrays()
    data[field][-1, [4, 9]] = value
    source = MemorySource(data)
    words = rf"2 of 11 Gaussians are invalid: NaN or infinity in {field} in 2 \(first row 4\); use --drop-invalid"
    with pytest.raises(InputError, match=words):
        check_scene(source, chunk_rows=chunk_rows)
    kept = check_scene(source, drop_invalid=True, chunk_rows=chunk_rows)
    assert kept.count == 9
    assert kept.notes[0].startswith("2 of 11 Gaussians left out as invalid: NaN or infinity in " + field)
    rows = np.delete(np.arange(11), [4, 9])
    for name, plane in kept.read(slice(0, 9), ALL).items():
        np.testing.assert_array_equal(plane, data[name][:, rows])


def test_a_row_with_two_faults_counts_once() -> None:
    data = arrays()
    data["means"][:, 2] = np.nan
    data["quats"][0, 2] = np.inf
    with pytest.raises(InputError, match=r"1 of 11 Gaussians are invalid: .* means in 1 .* quats in 1 "):
        check_scene(MemorySource(data))


@pytest.mark.parametrize("field", ["sh_dc", "sh_rest"])
def test_coefficients_whose_squares_leave_float32(field: str) -> None:
    data = arrays()
    data[field][-1, [2, 7]] = (1.1e15, -3e38)
    data[field][0, 3] = -9.9e14
    words = rf"2 of 11 Gaussians .* beyond \+-1e\+15 in {field} in 2 \(first row 2\)"
    with pytest.raises(InputError, match=words):
        check_scene(MemorySource(data))
    assert check_scene(MemorySource(data), drop_invalid=True).count == 9


@pytest.mark.parametrize("value", [0.0, -0.0, 1e-25, 1e-42, 3e19])
def test_quaternions_that_cannot_be_normalised(value: float) -> None:
    data = arrays()
    data["quats"][:, 7] = value
    with pytest.raises(InputError, match=r"quats of norm zero \(or beyond float32\) in 1 \(first row 7\)"):
        check_scene(MemorySource(data))
    assert check_scene(MemorySource(data), drop_invalid=True).count == 10


@pytest.mark.parametrize("value", [1e-18, 1e18])
def test_quaternions_of_any_norm_that_float32_can_handle_are_valid(value: float) -> None:
    data = arrays()
    data["quats"][:, 7] = value
    assert check_scene(MemorySource(data)).count == 11


def test_everything_invalid() -> None:
    data = arrays(3)
    data["means"][:] = np.nan
    with pytest.raises(InputError, match="all 3 Gaussians are invalid"):
        check_scene(MemorySource(data), drop_invalid=True)


@pytest.mark.parametrize("chunk_rows", [2, 64])
def test_flat_splats_take_the_smallest_finite_scale(chunk_rows: int) -> None:
    data = arrays()
    data["log_scales"][0, [1, 8]] = -np.inf
    data["log_scales"][2, 1] = -np.inf
    smallest = data["log_scales"][np.isfinite(data["log_scales"])].min()
    source = check_scene(MemorySource(data, origin=[1.0, 2.0, 3.0]), chunk_rows=chunk_rows)
    assert source.notes == (
        f"2 flat Gaussians: log-scales of -inf set to the smallest finite one, {float(smallest):.4g}",
    )
    read = source.read(slice(0, 11), ["log_scales", "means"])
    np.testing.assert_array_equal(read["log_scales"], np.maximum(data["log_scales"], smallest))
    np.testing.assert_array_equal(read["means"], data["means"])
    np.testing.assert_array_equal(source.origin, [1.0, 2.0, 3.0])
    assert data["log_scales"][0, 1] == -np.inf, "the input was changed"
    np.testing.assert_array_equal(
        source.select(np.array([8, 1])).read(slice(0, 2), ["log_scales"])["log_scales"], read["log_scales"][:, [8, 1]]
    )


def test_the_smallest_scale_is_taken_from_the_rows_that_stay() -> None:
    data = arrays()
    data["log_scales"][0, 1] = -np.inf
    data["log_scales"][0, 5] = -50.0
    data["means"][0, 5] = np.nan
    source = check_scene(MemorySource(data), drop_invalid=True)
    assert len(source.notes) == 2
    assert source.read(slice(0, 10), ["log_scales"])["log_scales"].min() > -10.0


def test_only_flat_scales() -> None:
    data = arrays(2)
    data["log_scales"][:] = -np.inf
    with pytest.raises(InputError, match="log_scales: all are -inf"):
        check_scene(MemorySource(data))


@pytest.mark.parametrize("chunk_rows", [2, 64])
def test_opacities_of_1_and_0_are_clamped_to_finite_logits(chunk_rows: int) -> None:
    data = arrays()
    data["opacity_logits"][0, :4] = (np.inf, -np.inf, 12.0, -9.0)
    source = check_scene(MemorySource(data), chunk_rows=chunk_rows)
    assert source.notes == ("2 Gaussians of opacity 1 or 0: logits of +-inf set to +-7 (0.999 or 0.001)",)
    read = source.read(slice(0, 11), ALL)
    np.testing.assert_array_equal(read["opacity_logits"][0, :4], (7.0, -7.0, 12.0, -9.0))
    for name in set(ALL) - {"opacity_logits"}:
        np.testing.assert_array_equal(read[name], data[name])
    assert data["opacity_logits"][0, 0] == np.inf, "the input was changed"
    assert source.valid and check_scene(source) is source


def test_flat_and_opaque_gaussians_of_a_marked_scene_with_invalid_rows() -> None:
    data = arrays()
    data["opacity_logits"][0, [3, 7]] = np.inf
    data["log_scales"][1, 3] = -np.inf
    data["means"][0, 7] = np.nan
    marked = MemorySource(data)
    marked.settings, marked.held_bytes, marked.comments = {"antialiased": True}, 99, ("flexgs-edge grid {}",)
    source = check_scene(marked, drop_invalid=True)
    assert [note.split(":")[0] for note in source.notes] == [
        "1 of 11 Gaussians left out as invalid",
        "1 flat Gaussians",
        "1 Gaussians of opacity 1 or 0",
    ]
    assert source.settings == {"antialiased": True} and source.held_bytes == 99
    assert source.comments == (), "clamped values do not lie on the file's grid"
    for field in ("log_scales", "opacity_logits"):
        assert np.isfinite(source.read(slice(0, 10), [field])[field]).all()


def test_a_file_of_another_program_with_opacities_of_1(wild: Path) -> None:
    source = check_scene(PlySource(wild / "wgpu-model.ply"))
    assert source.count == 9 and source.notes[-1].startswith("9 Gaussians of opacity 1 or 0")


def test_sh_count_survives_dropping() -> None:
    data = arrays()
    data["sh_rest"][:, 6:] = 0.0
    data["means"][0, [0, 8]] = np.nan
    assert check_scene(MemorySource(data, sh_count=6), drop_invalid=True).sh_count == 5


@pytest.mark.parametrize("seen", ["opacity_logits", "log_scales", "both"])
def test_files_that_are_activated_already_are_warned_of(seen: str, caplog: pytest.LogCaptureFixture) -> None:
    data = arrays(40)
    for name in ("opacity_logits", "log_scales"):
        if seen in (name, "both"):
            data[name] = np.random.default_rng(1).uniform(0.001, 1, data[name].shape).astype(np.float32)
    with caplog.at_level("WARNING", "flexgs_edge"):
        notes = check_scene(MemorySource(data), chunk_rows=3).notes
    assert any("activated already" in note for note in notes) == (seen == "both")
    assert ("all 40 opacities lie in 0..1 and all scales above 0" in caplog.text) == (seen == "both")


def test_splats_behind_enough_of_their_own_shape_and_place_are_left_out() -> None:
    count = BLOCK_ROWS + 3 * MOST_ALIKE
    given = arrays(count)
    crowd = np.concatenate([np.arange(5, 1005), np.arange(BLOCK_ROWS - 9, BLOCK_ROWS + MOST_ALIKE)])  # in both blocks
    for field in ("means", "log_scales", "quats", "opacity_logits"):
        given[field][:, crowd] = given[field][:, :1]
    given["means"][:, crowd[-1] + 1 :] = given["means"][:, :1]  # at the same place, each of another shape
    left = without_hidden(MemorySource(given))
    kept = np.setdiff1d(np.arange(count), crowd[MOST_ALIKE - 1 :])
    np.testing.assert_array_equal(left.read(slice(0, left.count), ["sh_dc"])["sh_dc"], given["sh_dc"][:, kept])
    assert left.notes[0].startswith("1010 of")


def test_pictures_stay_without_what_is_hidden() -> None:
    """A faint crowd, as opaque as just shows, and a bright splat behind it."""
    count = MOST_ALIKE + 200
    planes = {name: np.repeat(values[:, :1], count + 1, axis=1) for name, values in arrays().items()}
    planes["sh_dc"] = np.random.default_rng(0).normal(size=(3, count + 1)).astype(np.float32)
    planes["means"][:] = np.array([[0.0], [0.0], [4.0]])
    planes["means"][2, -1] = 6.0
    planes["log_scales"][:], planes["opacity_logits"][:] = 0.0, -5.5
    planes["opacity_logits"][:, -1], planes["sh_dc"][:, -1] = 5.0, 9.0
    source = MemorySource(planes)
    renderer, pictures = Renderer(open_form("w8"), large_budget()), []
    for each in (source, without_hidden(source)):
        with renderer.load(each) as scene:
            pictures.append(renderer.render(scene, make_camera(40, 30)).copy())
    assert without_hidden(source).count < source.count and pictures[0].any()
    np.testing.assert_array_equal(*pictures)


def test_a_scene_of_as_many_alike_as_can_show_stays_as_it_is() -> None:
    given = {name: np.repeat(values[:, :1], MOST_ALIKE, axis=1) for name, values in arrays().items()}
    source = MemorySource(given)
    assert without_hidden(source) is source
