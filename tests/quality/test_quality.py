"""PSNR, SSIM, drop, fidelity and the modelled drop, against their definitions."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from flexgs_edge.errors import InputError
from flexgs_edge.quality import psnr, view_quality


def images(seed: int, height: int = 300, width: int = 17) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return tuple(rng.normal(0.5, 0.5, (2, height, width, 3)).astype(np.float32))  # type: ignore[return-value]


@pytest.mark.parametrize("height", [1, 127, 128, 129, 300])
def test_mse_is_that_of_clamped_images_in_float64(height: int) -> None:
    a, b = images(height, height)
    expected = np.mean((np.clip(a, 0, 1).astype(np.float64) - np.clip(b, 0, 1)) ** 2)
    assert psnr.mse(a, b) == pytest.approx(expected, rel=1e-12)
    # Renders are transposed planes: the memory's order must not matter.
    turned = np.ascontiguousarray(a.transpose(2, 0, 1)).transpose(1, 2, 0)
    assert psnr.mse(turned, b) == pytest.approx(expected, rel=1e-12)


def test_mse_in_threads_is_that_of_its_images_whatever_is_asked_for_between() -> None:
    pairs = [images(seed) for seed in range(8)]
    later = [psnr.mse_later(a, b) for a, b in pairs]
    for _ in range(2):
        assert [found() for found in reversed(later)] == [psnr.mse(a, b) for a, b in reversed(pairs)]
    with pytest.raises(InputError, match="cannot be compared"):
        psnr.mse_later(pairs[0][0], pairs[0][1][:-1])


def test_values_outside_the_range_do_not_count() -> None:
    a = np.full((4, 4, 3), 1.5, np.float32)
    assert psnr.mse(a, np.full_like(a, 9.0)) == 0.0
    assert psnr.mse(-a, np.zeros_like(a)) == 0.0


def test_sizes_must_agree() -> None:
    with pytest.raises(InputError, match="images of 3x2 and 4x2 cannot be compared"):
        psnr.mse(np.zeros((2, 4, 3)), np.zeros((2, 3, 3)))


def test_psnr_of_identical_images_is_none_never_infinite() -> None:
    a, _ = images(1)
    assert psnr.psnr(psnr.mse(a, a)) is None
    assert psnr.psnr(1e-4) == pytest.approx(40.0)


@pytest.mark.parametrize(("values", "mean"), [([], None), ([None], None), ([30.0, None, 40.0], 35.0), ([30.0], 30.0)])
def test_mean_leaves_identical_views_out(values: list[float | None], mean: float | None) -> None:
    assert psnr.mean_psnr(values) == mean


def test_modelled_drop_known_values() -> None:
    assert psnr.modelled_drop(psnr.mse_of_psnr(41.87), 36.0) == pytest.approx(1.0, abs=0.01)
    assert psnr.modelled_drop(0.0) == 0.0
    # Errors that are independent add up: the model is exact then.
    rng = np.random.default_rng(0)
    photo = np.full((400, 400, 3), 0.5)
    original = photo + rng.normal(0, 0.02, photo.shape)
    compressed = original + rng.normal(0, 0.01, photo.shape)
    base = psnr.psnr(psnr.mse(original, photo))
    assert base is not None
    real = psnr.drop(psnr.mse(original, photo), psnr.mse(compressed, photo))
    assert psnr.modelled_drop(psnr.mse(compressed, original), base) == pytest.approx(real, abs=0.02)


def test_a_view_with_a_photo() -> None:
    original, image = images(3, 20, 20)
    photo = np.clip(original + 0.1, 0, 1)
    view = view_quality.compare_view(
        *("v", image, original, photo),
        ssims=lambda pairs: [float(a[0, 0, 0] - b[0, 0, 0]) for a, b in pairs],
        flips=lambda pairs: [float(a[1, 0, 0] - b[1, 0, 0]) for a, b in pairs],
    )
    assert view.psnr is not None and view.original_psnr is not None and view.drop is not None
    assert view.drop == pytest.approx(view.original_psnr - view.psnr)
    assert view.fidelity == psnr.psnr(psnr.mse(image, original))
    assert view.ssim_original == float(image[0, 0, 0] - original[0, 0, 0])
    assert view.ssim_photo == float(image[0, 0, 0] - photo[0, 0, 0])
    assert view.original_ssim == float(original[0, 0, 0] - photo[0, 0, 0])
    assert view.flip_original == float(image[1, 0, 0] - original[1, 0, 0])
    assert view.flip_photo == float(image[1, 0, 0] - photo[1, 0, 0])
    assert view.original_flip == float(original[1, 0, 0] - photo[1, 0, 0])


def test_a_known_ssim_of_the_original_is_not_measured_again() -> None:
    original, image = images(3, 20, 20)
    photo, asked = np.clip(original + 0.1, 0, 1), []

    def ssims(pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> list[float | None]:
        asked.extend(pairs)
        return [0.25] * len(pairs)

    view = view_quality.compare_view("v", image, original, photo, original_ssim=0.75, ssims=ssims)
    assert (view.ssim_original, view.ssim_photo, view.original_ssim) == (0.25, 0.25, 0.75)
    assert [(a is image, b is original, b is photo) for a, b in asked] == [(True, True, False), (True, False, True)]
    # Without a measure of its own, a view has no SSIM at all.
    assert view_quality.compare_view("v", image, original, photo, original_ssim=0.75).original_ssim is None


def test_a_view_without_a_photo_has_no_drop() -> None:
    original, image = images(4, 12, 12)
    view = view_quality.compare_view("v", image, original)
    assert view.drop is None and view.psnr is None and view.ssim_original is None and view.fidelity is not None


def test_drop_of_renders_equal_to_the_photo_is_finite() -> None:
    photo, other = images(5, 12, 12)
    same = view_quality.compare_view("v", photo, photo, np.clip(photo, 0, 1))
    assert same.drop == 0.0 and same.psnr is None and same.fidelity is None
    worse = view_quality.compare_view("v", other, photo, np.clip(photo, 0, 1))
    assert worse.drop is not None and 0 < worse.drop < math.inf


def test_means_and_worst_over_views() -> None:
    views = (
        view_quality.ViewQuality("a", 1e-4, 2e-3, 1e-3),
        view_quality.ViewQuality("b", 0.0, 1e-3, 1e-3),
        view_quality.ViewQuality("c", 1e-3, 4e-3, 1e-3),
    )
    found = view_quality.Quality(views, base_psnr=30.0)
    assert found.fidelity == pytest.approx(35.0) and found.identical == 1
    assert found.drop == pytest.approx((10 * math.log10(2) + 0 + 10 * math.log10(4)) / 3)
    assert found.modelled_drop == pytest.approx(10 * math.log10(1 + (1.1e-3 / 3) / 1e-3))
    assert found.worst is views[2]
    without = view_quality.Quality(tuple(view_quality.ViewQuality(v.name, v.error) for v in views))
    assert without.drop is None and without.worst is not None and without.worst.name == "c"
    assert view_quality.Quality(()).worst is None
