"""Images and statistics of every form against the float64 reference, within bounds that follow from counted roundings."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import reference_renderer
from fits import use_fit
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.constants import FIXED_ERROR
from flexgs_edge.kernels.twins.project import sh_basis
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource, SceneSource
from kernel_fixtures import ALL_FORMS, count, draw, open_form, removal_costs, same_bits
from reference_renderer import Reference
from synthetic import SIZES, joined, look_from, make_camera, make_splats, random_scene

NEAR = np.float32(0.2)


@pytest.fixture(autouse=True)
def _small_pair_buffer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hundreds of small scenes: getting 32 MB for the pairs of each would be most of it."""
    use_fit(monkeypatch, pairs=1 << 12)


def assert_matches(
    form: str,
    source: SceneSource,
    camera: Camera,
    reference: Reference,
    near: float = 0.2,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    antialiased: bool = False,
) -> None:
    """Image within the bound where no decision is on the edge; hits and weights within what those decisions leave open."""
    backend = open_form(form)
    image = draw(backend, source, camera, near, background, antialiased)
    difference = abs(image - reference.image).max(axis=2)
    assert np.isfinite(image).all()
    beyond = (difference - reference.bound)[~reference.fragile]
    assert (beyond <= 0).all(), beyond.max()
    statistics = count(backend, source, [camera], near, antialiased)
    assert (abs(statistics.hits - reference.hits) <= reference.unsure).all()
    assert (abs(statistics.weight_sums - reference.weights) <= reference.weight_bound).all()


@cache
def random_case(
    seed: int, degree: int, antialiased: bool = False, size: float = -2.0
) -> tuple[MemorySource, Camera, Reference]:
    rotation, translation = look_from(seed)
    camera = make_camera(45, 37, rotation=rotation, translation=translation)
    source = random_scene(60, seed, degree, size)
    return (
        source,
        camera,
        reference_renderer.render(source, camera, background=(0.2, 0.5, 1.0), antialiased=antialiased),
    )


@pytest.mark.parametrize("degree", range(5))
@pytest.mark.parametrize("form", ALL_FORMS)
def test_random_scenes(form: str, degree: int) -> None:
    source, camera, reference = random_case(degree, degree)
    assert reference.fragile.mean() < 0.01 and np.median(reference.bound) < 2e-4  # otherwise this says nothing
    assert_matches(form, source, camera, reference, background=(0.2, 0.5, 1.0))


def test_rounding_is_small_and_flips_are_rare() -> None:
    """The bound above adds up the worst case. Roundings behave like noise: 1e-6 in the mean, 1e-5 of the tests flip at most."""
    tests, flips, lean, squares = 0, 0, 0, []
    for seed in range(20):
        source, camera, reference = random_case(seed, seed % 5)
        image = draw(open_form("w16"), source, camera, background=(0.2, 0.5, 1.0))
        squares.append(np.square(image - reference.image)[~reference.fragile].mean())
        difference = count(open_form("w16"), source, [camera]).hits - reference.hits
        tests += source.count * camera.width * camera.height
        flips += int(abs(difference).sum())
        lean += int(difference.sum())
    assert np.sqrt(np.mean(squares)) < 1e-6
    assert flips <= max(1e-5 * tests, 1) and abs(lean) <= 3 * np.sqrt(flips) + 1


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("form", ALL_FORMS)
def test_image_sizes(form: str, size: tuple[int, int]) -> None:
    source, camera = random_scene(40, 3, 1), make_camera(*size, focal=30)
    assert_matches(form, source, camera, reference_renderer.render(source, camera))


TILT_POSITIONS = {
    "inside": (23.3, 21.6),
    "tile border": (16.0, 23.5),
    "tile corner": (15.5, 15.5),
    "left edge": (-0.3, 18.0),
    "outside the corner": (-2.5, -1.5),
    "right edge": (47.2, 20.0),
    "below": (20.0, 35.0),
}


@cache
def tilted(position: str, step: int, opacity: float) -> tuple[MemorySource, Camera, Reference]:
    """A needle of 9 by 0.8 pixels (before dilation) at one of 24 rotations."""
    camera = make_camera(48, 33)
    x, y = TILT_POSITIONS[position]
    depth = 4.0
    mean = [(x - camera.cx) / camera.fx * depth, (y - camera.cy) / camera.fy * depth, depth]
    deviations = np.array([[9, 0.8, 0.8]]) * depth / camera.fx
    source = make_splats(np.array([mean]), deviations, np.pi * step / 24 + 0.01, opacity)
    return source, camera, reference_renderer.render(source, camera)


@pytest.mark.parametrize("position", TILT_POSITIONS)
@pytest.mark.parametrize("form", ALL_FORMS)
def test_tilts(form: str, position: str) -> None:
    """A sign slip in the conic's B or in the spans' slope cuts tilted splats, at some angles only slightly."""
    seen = 0
    for step in range(24):
        source, camera, reference = tilted(position, step, 0.95 if step % 2 else 0.3)
        assert_matches(form, source, camera, reference)
        seen += int(reference.hits.sum())
    assert seen > 300


@pytest.mark.parametrize("form", ALL_FORMS)
def test_tilts_in_three_dimensions(form: str) -> None:
    """Needles turned in all directions, off the axis of a turned camera, under dilation and perspective."""
    rng = np.random.default_rng(11)
    rotation, translation = look_from(5)
    camera = make_camera(48, 40, rotation=rotation, translation=translation, centre=(20.0, 25.5))
    for _ in range(12):
        arrays = make_splats(np.array([[0.3, -0.2, 4.2]]) + rng.normal(0, 0.4, 3), np.array([[0.8, 0.05, 0.02]])).read(
            slice(0, 1), list(FIELD)
        )
        arrays["quats"][:, 0] = rng.normal(size=4)
        source = MemorySource(arrays)
        assert_matches(form, source, camera, reference_renderer.render(source, camera))


@pytest.mark.parametrize("form", ALL_FORMS)
def test_near_plane(form: str) -> None:
    """Culled at z <= near, drawn one float32 above it; behind and at the camera culled as well."""
    depths = [-4, -1e-3, 0, np.nextafter(NEAR, np.float32(0)), NEAR, np.nextafter(NEAR, np.float32(1)), 0.25, 4]
    camera = make_camera(32, 32)
    for depth in depths:
        source = make_splats(np.array([[0, 0, depth]], np.float32), np.array([[0.02] * 3]))
        reference = reference_renderer.render(source, camera)
        assert reference.hits.any() == (depth > NEAR)
        assert_matches(form, source, camera, reference)
        if depth > 0:
            assert count(open_form(form), source, [camera], near=2 * depth).hits.sum() == 0
            assert count(open_form(form), source, [camera], near=depth / 2).hits.sum() > 0


@pytest.mark.parametrize("form", ALL_FORMS)
def test_opacity_cull(form: str) -> None:
    """o < 1/255 on both sides: just above, the splat shows at the pixel under its mean; below, nowhere."""
    camera = make_camera(33, 33)
    for factor, hits in ((1 - 1e-4, 0), (1 + 1e-4, 1), (0.5, 0), (1e-6, 0), (0, 0)):
        opacity = max(factor / 255, 1e-30)
        source = make_splats(np.array([[0, 0, 4.0]]), np.array([[0.05] * 3]), opacity=opacity)
        reference = reference_renderer.render(source, camera)
        assert reference.hits.sum() == hits and not reference.unsure.any()
        assert count(open_form(form), source, [camera]).hits.sum() == hits


@pytest.mark.parametrize("form", ALL_FORMS)
def test_alpha_threshold(form: str) -> None:
    """A wide faint splat is drawn where alpha >= 1/255 and nowhere else."""
    camera = make_camera(48, 48)
    for opacity in (0.005, 0.02, 0.3):
        source = make_splats(np.array([[0.1, 0.0, 4.0]]), np.array([[1.0, 0.7, 0.5]]), 0.4, opacity)
        reference = reference_renderer.render(source, camera)
        assert 0 < reference.hits[0] < 48 * 48
        assert_matches(form, source, camera, reference)


@pytest.mark.parametrize("form", ALL_FORMS)
def test_determinant_cull(form: str) -> None:
    """Overflowing covariances are not drawn; a needle as long as float32 bears is."""
    camera = make_camera(40, 40)
    for log_deviations, turn, shown in (
        ((60, 0, 0), 0.3, False),
        ((25, 0, 0), 0.3, False),
        ((25, 25, 25), 0.0, False),  # a and c are finite, their product is not
        ((6, 0, 0), 0.3, True),
    ):
        source = make_splats(np.array([[0, 0, 4.0]]), np.exp([log_deviations]), turn)
        reference = reference_renderer.render(source, camera)
        assert reference.shown[0] == shown
        image = draw(open_form(form), source, camera)
        assert image.any() == shown and np.isfinite(image).all()


@pytest.mark.parametrize("form", ALL_FORMS)
def test_nothing_in_view(form: str) -> None:
    """All behind, beside, or none at all: the background, and no hits."""
    camera = make_camera(20, 17)
    behind = make_splats(np.array([[0, 0, -4.0], [1, 1, -1]]), np.full((2, 3), 0.1))
    beside = make_splats(np.array([[400, 0, 4.0], [0, -300, 4]]), np.full((2, 3), 0.1))
    for source in (behind, beside, random_scene(0)):
        image = draw(open_form(form), source, camera, background=(0.25, 0.5, 1.0))
        np.testing.assert_array_equal(image, np.broadcast_to(np.array([0.25, 0.5, 1.0], np.float32), (17, 20, 3)))
        assert not count(open_form(form), source, [camera]).hits.any()


@pytest.mark.parametrize("form", ALL_FORMS)
def test_one_gaussian_by_hand(form: str) -> None:
    """Centred on pixel (16, 16): alpha there is the opacity, one sigma to the right it is o exp(-1/2)."""
    camera = make_camera(33, 33, focal=40)
    deviation = np.sqrt(16 - 0.3) * 4.0 / 40
    source = make_splats(
        np.array([[0, 0, 4.0]]), np.array([[deviation] * 3]), opacity=0.6, colours=np.array([[1, 0.5, 0.25]])
    )
    image = draw(open_form(form), source, camera)
    np.testing.assert_allclose(image[16, 16], np.array([1, 0.5, 0.25]) * 0.6, rtol=2e-6)
    np.testing.assert_allclose(image[16, 20], np.array([1, 0.5, 0.25]) * 0.6 * np.exp(-0.5), rtol=2e-6)


@pytest.mark.parametrize("form", ALL_FORMS)
def test_equal_depths_keep_the_order_of_rows(form: str) -> None:
    """40 splats at one depth on top of each other, more than a sort block holds."""
    rng = np.random.default_rng(12)
    means = np.stack([rng.uniform(-0.5, 0.5, 40), rng.uniform(-0.5, 0.5, 40), np.full(40, 4.0)], axis=1)
    source = make_splats(means, np.full((40, 3), 0.3), opacity=0.4, colours=rng.uniform(0, 1, (40, 3)))
    camera = make_camera(32, 32)
    reference = reference_renderer.render(source, camera)
    assert_matches(form, source, camera, reference)
    turned = source.select(np.arange(40)[::-1])
    assert abs(draw(open_form(form), turned, camera) - reference.image).max() > 0.01
    # The input's row decides, whatever else is between: a second scene behind changes no tie.
    behind = make_splats(means + np.array([0, 0, 3.0]), np.full((40, 3), 0.3), opacity=0.4)
    both = joined(behind, source)
    assert_matches(form, both, camera, reference_renderer.render(both, camera))


@pytest.mark.parametrize("form", ALL_FORMS)
def test_alpha_cap_and_stop(form: str) -> None:
    """A stack of opaque splats: alpha is capped at 0.99, and the splat that would end the pixel is neither drawn nor hit."""
    depths = np.linspace(3, 5, 6)
    means = np.stack([0 * depths, 0 * depths, depths], axis=1)
    colours = np.eye(3)[np.arange(6) % 3]
    source = make_splats(means, np.full((6, 3), 0.5), opacity=0.9999, colours=colours)
    camera = make_camera(17, 17)
    reference = reference_renderer.render(source, camera)
    middle = draw(open_form(form), source, camera)[8, 8]
    # 0.99 of red, 0.0099 of green, and 1e-6 left: the third would end the pixel (T = 1e-6 < 1e-4), so blue is not drawn.
    np.testing.assert_allclose(middle, [0.99, 0, 0], atol=1e-6)
    assert_matches(form, source, camera, reference)
    faint = make_splats(means, np.full((6, 3), 0.5), opacity=np.array([0.9, 0.9, 0.9, 0.89, 0.9, 0.9]), colours=colours)
    assert_matches(form, faint, camera, reference_renderer.render(faint, camera))


@pytest.mark.parametrize("form", ALL_FORMS)
def test_a_pixel_that_ended_stays_ended(form: str) -> None:
    """After a splat too opaque for a pixel a fainter one behind it may not be drawn there, although T would allow it."""
    means = np.array([[0, 0, 3.0], [0, 0, 3.5], [0, 0, 4.0], [0, 0, 4.5]])
    opacity = np.array([0.98, 0.98, 0.98, 0.1])  # T = 0.02, 4e-4, then 8e-6 < 1e-4: the third ends it
    source = make_splats(means, np.full((4, 3), 2.0), opacity=opacity)
    camera = make_camera(5, 5)
    reference = reference_renderer.render(source, camera)
    assert reference.hits.tolist() == [25, 25, 0, 0]
    assert_matches(form, source, camera, reference)
    assert count(open_form(form), source, [camera]).hits.tolist() == [25, 25, 0, 0]


@pytest.mark.parametrize("form", ALL_FORMS)
def test_jacobian_clamp(form: str) -> None:
    """Wide splats beside the image reach into it by a Jacobian taken at 0.15 of the image's size outside, on all sides."""
    camera = make_camera(40, 30, focal=25, centre=(14.0, 17.5))
    for x, y in ((3.5, 0), (-3.2, 0), (0.2, 2.8), (0, -2.6), (2.5, 2.2)):
        source = make_splats(np.array([[x, y, 2.0]]), np.array([[1.2, 1.0, 0.6]]), 0.3, 0.9)
        reference = reference_renderer.render(source, camera)
        assert reference.hits.any()
        assert_matches(form, source, camera, reference)


@pytest.mark.parametrize("form", ALL_FORMS)
def test_principal_point(form: str) -> None:
    """Anywhere, also outside the image."""
    source = random_scene(30, 13)
    for centre in ((0.0, 0.0), (39.0, 4.0), (-20.0, 50.0)):
        camera = make_camera(40, 30, centre=centre)
        assert_matches(form, source, camera, reference_renderer.render(source, camera))


@pytest.mark.parametrize("form", ALL_FORMS)
def test_scene_far_from_zero(form: str) -> None:
    """Positions are relative to an origin: a scene at 10^6 is drawn as well as one at zero."""
    far = (1e6, -2e6, 5e5)
    source = random_scene(40, 14, 2, origin=far)
    rotation, translation = look_from(3)
    near_camera = make_camera(40, 30, rotation=rotation, translation=translation)
    moved = near_camera.moved(-np.array(far))
    reference = reference_renderer.render(random_scene(40, 14, 2), near_camera)
    assert_matches(form, source, moved, reference)


@pytest.mark.parametrize("form", ALL_FORMS)
def test_removal_costs(form: str) -> None:
    """Squared error of removing each splat, and sums of squared weights, where no decision is on the edge."""
    for seed in range(3):
        source, camera = random_scene(50, seed + 40), make_camera(40, 30)
        reference = reference_renderer.render(source, camera, background=(0.2, 0.5, 1.0))
        errors, weights = removal_costs(open_form(form), source, camera, (0.2, 0.5, 1.0))
        sure = reference.unsure == 0
        assert sure.mean() > 0.4
        np.testing.assert_allclose(errors[sure] / FIXED_ERROR, reference.removal[sure], rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(weights[sure] / FIXED_ERROR, reference.weights2[sure], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("form", ["w16", "w8", "numpy"])
def test_removal_is_what_leaving_out_costs(form: str) -> None:
    """With few faint splats no pixel ends: removing a row and rendering again costs exactly what was measured."""
    source, camera = random_scene(8, 50, opacity=-1, size=-1.5), make_camera(40, 30)
    errors, _ = removal_costs(open_form(form), source, camera)
    image = draw(open_form(form), source, camera).astype(np.float64)
    for row in range(source.count):
        without = draw(open_form(form), source.select(np.delete(np.arange(source.count), row)), camera)
        measured = errors[row] / FIXED_ERROR
        assert abs(np.square(image - without).sum() - measured) <= 1e-5 * max(measured, 0.01)


@pytest.mark.parametrize("form", ALL_FORMS)
def test_rows_without_sh(form: str) -> None:
    """The block behind sh_count is drawn as if its SH were zeros."""
    arrays = random_scene(70, 15, 3).read(slice(0, 70), list(FIELD))
    arrays["sh_rest"][:, 31:] = 0
    camera = make_camera(40, 30)
    image = draw(open_form(form), MemorySource(arrays, 3), camera)
    assert same_bits(image, draw(open_form(form), MemorySource(arrays, 3, sh_count=31), camera))


@pytest.mark.parametrize("degree", range(5))
def test_sh_basis_of_the_twin(degree: int) -> None:
    """The written polynomials are the real spherical harmonics, signs and all."""
    rng = np.random.default_rng(17)
    direction = rng.normal(size=(200, 3))
    direction = (direction / np.linalg.norm(direction, axis=1)[:, None]).astype(np.float32)
    exact = reference_renderer.sh_basis(degree, direction.astype(np.float64))
    for ours, theirs in zip(sh_basis(degree, *direction.T), exact[1:]):
        np.testing.assert_allclose(ours, theirs, atol=2e-6)


@pytest.mark.parametrize("size", [-2.0, -4.0])
@pytest.mark.parametrize("form", ALL_FORMS)
def test_antialiased_scenes(form: str, size: float) -> None:
    """Opacity compensation, at a third of a pixel and at four pixels a splat, within the same bounds."""
    source, camera, reference = random_case(1, 1, True, size)
    assert reference.fragile.mean() < 0.01 and np.median(reference.bound) < 2e-4
    plain = random_case(1, 1, False, size)[2]
    assert reference.hits.sum() < (0.75 if size < -3 else 0.99) * plain.hits.sum()
    assert_matches(form, source, camera, reference, background=(0.2, 0.5, 1.0), antialiased=True)


@pytest.mark.parametrize("form", ALL_FORMS)
def test_antialiased_needles_and_flat_splats(form: str) -> None:
    """Areas that float32 cannot tell from the covariance's entries: peaks of needles up to 300 pixels, and of flat splats."""
    rng = np.random.default_rng(31)
    camera = make_camera(33, 31, focal=300)
    peaks = []
    for deviations in (
        (4.0, 0.003, 0.003),
        (4.0, 0.02, 0.003),
        (1.0, 1.0, 1e-9),
        (2.0, 1e-4, 0.3),
        (0.01, 0.01, 1e-12),
    ):
        for _ in range(6):
            arrays = make_splats(np.array([[0.0, 0.0, 4.0]]), np.array([deviations]), opacity=0.9).read(
                slice(0, 1), list(FIELD)
            )
            arrays["quats"][:, 0] = rng.normal(size=4)
            source = MemorySource(arrays)
            peak = reference_renderer.render(source, camera, antialiased=True).image[15, 16, 0]
            assert draw(open_form(form), source, camera, antialiased=True)[15, 16, 0] == pytest.approx(peak, abs=2e-5)
            peaks.append(peak)
    assert min(peaks) < 0.3 and max(peaks) > 0.85


def test_compensation_keeps_the_light_of_far_splats() -> None:
    """A thin splat from 8 times as far must give 1/64 of the light; the dilation alone makes it many times brighter."""
    light = np.zeros((2, 2))
    for angle in np.linspace(0, np.pi, 6, endpoint=False):
        source = make_splats(np.zeros((1, 3)), np.array([[0.2, 0.03, 0.03]]), angle, 0.9)
        for row, antialiased in enumerate((False, True)):
            for column, distance in enumerate((4.0, 32.0)):
                camera = make_camera(41, 41, focal=60, translation=(0.0, 0.0, distance))
                image = draw(open_form("w16"), source, camera, antialiased=antialiased)
                light[row, column] += image.sum(dtype=np.float64) * distance**2
    assert light[0, 1] > 8 * light[0, 0]
    # Less what alpha < 1/255 cuts off: 1 % of the near one's light, 8 % of the far one's.
    assert light[1, 1] == pytest.approx(light[1, 0] * 0.92 / 0.99, rel=0.03)


@pytest.mark.parametrize("form", ALL_FORMS)
def test_antialiased_removal_costs(form: str) -> None:
    """Compensated opacities are what removal is measured with."""
    source, camera = random_scene(50, 43, size=-3.5), make_camera(40, 30)
    reference = reference_renderer.render(source, camera, background=(0.2, 0.5, 1.0), antialiased=True)
    errors, weights = removal_costs(open_form(form), source, camera, (0.2, 0.5, 1.0), antialiased=True)
    sure = (reference.unsure == 0) & (reference.hits > 0)
    assert sure.sum() > 10
    np.testing.assert_allclose(errors[sure] / FIXED_ERROR, reference.removal[sure], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(weights[sure] / FIXED_ERROR, reference.weights2[sure], rtol=1e-4, atol=1e-6)
