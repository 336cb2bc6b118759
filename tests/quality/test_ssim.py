"""SSIM on every form of the kernels, against scikit-image's in double precision."""

from __future__ import annotations

import numpy as np
import pytest
from skimage.metrics import structural_similarity

from flexgs_edge.errors import BudgetError
from flexgs_edge.kernels.backend import TwinBackend
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.quality import similarity
from flexgs_edge.quality.similarity import flips, ssim_bytes, ssims
from kernel_fixtures import ALL_FORMS, open_form


def images(height: int, width: int, noise: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """Smooth waves that leave [0, 1] in places, and the same with noise."""
    y, x = (line[..., None] / 9.0 for line in np.mgrid[:height, :width])
    wave = 0.5 + 0.6 * np.sin(x + np.arange(3)) * np.cos(0.7 * y)
    noisy = wave + np.random.default_rng(height).normal(0, noise, wave.shape)
    return wave.astype(np.float32), noisy.astype(np.float32)


@pytest.mark.parametrize(("height", "width"), [(11, 11), (32, 40), (57, 131)])
def test_ssim_is_scikit_images_with_the_papers_window(height: int, width: int) -> None:
    a, b = images(height, width)
    clamped = (np.clip(image, 0, 1).astype(np.float64) for image in (a, b))
    expected = structural_similarity(
        *clamped, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1.0, channel_axis=2
    )
    found = {tuple(ssims(open_form(form), [(a, b), (a, a)])) for form in ALL_FORMS}
    assert len(found) == 1, "forms differ"
    similar, same = found.pop()
    # Moments are rounded at about 1e-6, 1e-3 of C2, in one window; over many windows that cancels.
    assert similar == pytest.approx(expected, abs=5e-5 if height == 11 else 2e-6) and same == pytest.approx(
        1.0, abs=1e-6
    )


def test_pictures_smaller_than_the_window_have_none() -> None:
    a, b = images(40, 10)
    assert ssims(open_form("w8"), [(a, b)]) == [None] and ssims(open_form("w8"), []) == []


def test_what_it_takes_is_what_it_says_and_comes_back() -> None:
    a, b = images(30, 50)
    size = ssim_bytes(50, 30)
    budget = MemoryBudget(size)
    ssims(TwinBackend(budget), [(a, b)])
    assert budget.used == 0
    with pytest.raises(BudgetError):
        ssims(TwinBackend(MemoryBudget(size * 3 // 4)), [(a, b)])


@pytest.mark.parametrize("part", [(20, 23, 30, 31), (0, 1, 0, 1), (56, 57, 130, 131), (0, 0, 0, 0)])
def test_pictures_that_differ_in_a_part_alone_have_the_figures_of_the_whole(
    part: tuple[int, int, int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    top, bottom, left, right = part
    a, noisy = images(57, 131, 0.5)
    b = a.copy()
    b[top:bottom, left:right] = noisy[top:bottom, left:right]
    backend = open_form("w8")
    found = ssims(backend, [(a, b)]), flips(backend, [(a, b)])
    monkeypatch.setattr(similarity, "_differing", lambda pairs, reach: pairs)
    assert found == (ssims(backend, [(a, b)]), flips(backend, [(a, b)]))
