"""Photos of another exposure are brought to that of the original, and photos that cannot judge a view do not."""

from __future__ import annotations

import numpy as np
import pytest

from flexgs_edge.quality.psnr import contrast, drop, exposure_gains, far_bases, mse, mse_of_psnr, with_gains
from flexgs_edge.quality.view_quality import Quality, ViewQuality
from flexgs_edge.run.quality_evaluator import measurement_of

RNG = np.random.default_rng(63)
STOPS = np.array([-1.0, -0.4, 0.7])


def picture(noise: float) -> tuple[np.ndarray, np.ndarray]:
    """A render and its even photo, [96, 128, 3]."""
    y, x = np.mgrid[:96, :128][..., None]
    image = np.float32(0.4) + np.float32(0.3) * np.sin(x / 9 + y / 7 + np.arange(3)).astype(np.float32)
    return image, np.clip(image + noise * RNG.standard_normal(image.shape), 0, 1).astype(np.float32)


def exposed(photo: np.ndarray, stops: np.ndarray) -> np.ndarray:
    """The photo in 8 bits at another exposure and white balance."""
    return np.round(with_gains(photo, 2.0**stops, np.zeros_like(photo)) * 255).astype(np.float32) / 255


@pytest.mark.parametrize("stops", [STOPS, -0.7 * STOPS, np.full(3, 0.7)])
def test_a_fitted_photo_is_the_even_one(stops: np.ndarray) -> None:
    image, photo = picture(0.03)
    taken = exposed(photo, stops)
    gains = exposure_gains(image, taken)
    assert gains is not None and np.log2(gains) == pytest.approx(-stops, abs=0.06)
    even, fitted = mse(image, photo), mse(image, with_gains(taken, gains, image))
    assert drop(even, fitted) == pytest.approx(0.0, abs=0.2) and mse(image, taken) > 4 * even


def test_a_clipped_pixel_tells_only_that_there_was_as_much_light() -> None:
    image, photo = picture(0.0)
    taken = exposed(photo, np.full(3, 1.5))
    assert (taken == 1.0).mean() > 0.1
    fitted = with_gains(taken, exposure_gains(image, taken), image)
    assert mse(image, fitted) < 1e-5 and mse(0.5 * image, fitted) == pytest.approx(mse(0.5 * image, photo), rel=0.01)


def test_even_and_clipped_photos_stay_as_they_are() -> None:
    image, photo = picture(0.03)
    assert exposure_gains(image, photo) is None
    assert exposure_gains(image, exposed(photo, np.full(3, 0.05))) is None
    assert with_gains(photo, None, image) is photo
    for flat in (np.zeros_like(photo), np.ones_like(photo)):
        assert exposure_gains(image, flat) is None
    assert exposure_gains(image, (photo > 0.5).astype(np.float32)) is None  # a mask


def test_photos_that_show_no_loss_do_not_judge() -> None:
    good, wrong = mse_of_psnr(28.0), mse_of_psnr(16.0)
    seen, mixed = [mse_of_psnr(13.0)] * 5, [mse_of_psnr(13.0)] * 4 + [mse_of_psnr(16.5)]
    # Sixteen dB below a flat picture is far, but an even scene with a poorer view is not.
    assert far_bases([good] * 4 + [mse_of_psnr(24.0)], seen) == [None] * 5
    assert far_bases([good] * 4 + [mse_of_psnr(20.0)], seen)[4] == pytest.approx(28.0)
    assert far_bases([good] * 4 + [wrong], mixed) == [None] * 4 + [pytest.approx(28.0)]
    # No photo fits: as if there were none. One that fits by chance does not set the base.
    assert far_bases([wrong] * 5, [wrong] * 5, 36.0) == pytest.approx([36.0] * 5)
    assert far_bases([wrong] * 4 + [mse_of_psnr(20.0)], [wrong] * 5) == pytest.approx([34.0] * 5)
    assert far_bases([0.0] * 3, seen[:3]) == [None] * 3 and far_bases([], []) == []


def test_a_view_that_its_photo_cannot_judge_counts_by_the_modelled_drop() -> None:
    """Grey loses nothing against a photo of something else, and gains there allow no loss elsewhere."""
    near = ViewQuality("near", 1e-4, 2e-3, 1e-3, ssim_original=0.97, ssim_photo=0.90, original_ssim=0.91)
    gains = ViewQuality("gains", 1e-4, 0.5e-3, 1e-3, ssim_original=0.97, ssim_photo=0.95, original_ssim=0.91)
    far = ViewQuality("far", 9e-3, 2e-2, 3e-2, ssim_original=0.5, ssim_photo=0.4, original_ssim=0.2, far_base=30.0)
    assert far.drop is not None and far.drop < 0 and far.loss == pytest.approx(10.0)
    quality = Quality((near, gains, far))
    found = measurement_of(quality)
    assert (
        found.drop == pytest.approx((10 * np.log10(2) + 0 + 10.0) / 3) and quality.drop is not None and quality.drop < 0
    )
    assert found.ssim_drop == pytest.approx((0.01 + 0 + 0) / 3)
    assert found.worst is not None and found.worst.drop == pytest.approx(10.0) and quality.worst is far


def test_contrast_is_the_error_of_a_flat_picture() -> None:
    image, _ = picture(0.0)
    assert contrast(image) == pytest.approx(
        mse(np.broadcast_to(image.mean(axis=(0, 1)), image.shape).copy(), image), rel=1e-4
    )
