"""FLIP on every form of the kernels, against NVIDIA's own program."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageFilter

from flexgs_edge import constants
from flexgs_edge.errors import BudgetError, InputError
from flexgs_edge.kernels.backend import TwinBackend
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.quality import similarity
from flexgs_edge.quality.similarity import flip_bytes, flip_maps, flips, taps
from kernel_fixtures import ALL_FORMS, open_form

PHOTOS = Path(__file__).resolve().parents[2] / "samples" / "still_life" / "images"
Pair = tuple[np.ndarray, np.ndarray]


def waves(height: int, width: int, noise: float = 0.05) -> Pair:
    """Smooth waves that leave [0, 1] in places, and the same with noise."""
    y, x = (line[..., None] / 9.0 for line in np.mgrid[:height, :width])
    wave = 0.5 + 0.6 * np.sin(x + np.arange(3)) * np.cos(0.7 * y)
    noisy = wave + np.random.default_rng(height).normal(0, noise, wave.shape)
    return wave.astype(np.float32), noisy.astype(np.float32)


def flat(colour: tuple[float, float, float]) -> np.ndarray:
    return np.full((24, 24, 3), colour, np.float32)


def ten_pairs() -> dict[str, Pair]:
    """Pairs that differ by noise, colour, blur, place, steps of grey, JPEG and view; some smaller than the filters."""
    paths = sorted(PHOTOS.iterdir())
    one, other = (Image.open(path).convert("RGB") for path in (paths[0], paths[40]))

    def floats(picture: Image.Image) -> np.ndarray:
        return np.asarray(picture, np.float32) / np.float32(255)

    photo = floats(one)
    noise = np.random.default_rng(1).normal(0, 0.03, photo.shape).astype(np.float32)
    lines = np.zeros((60, 70, 3), np.float32)
    lines[::7], lines[:, ::9] = 1.0, (0.2, 0.9, 0.1)
    return {
        "noise": (photo, photo + noise),
        "views": (photo, floats(other)),
        "blur": (photo, floats(one.filter(ImageFilter.GaussianBlur(2)))),
        "shift": (photo, np.roll(photo, 1, axis=1)),
        "tint": (photo, photo * np.float32([1.1, 1.0, 0.85])),
        "steps": (photo, np.rint(photo * 12) / np.float32(12)),
        "lines": (lines, lines.transpose(1, 0, 2)[:60].repeat(2, axis=1)[:, :70]),
        "waves": waves(130, 57, 0.3),
        "hardly": waves(90, 200, 1e-3),
        "small": waves(5, 7),
    }


PAIRS = ten_pairs()


@pytest.mark.parametrize("name", PAIRS)
def test_flip_is_nvidias(name: str) -> None:
    evaluator = pytest.importorskip("flip_evaluator")
    a, b = PAIRS[name]
    clamped = (np.ascontiguousarray(np.clip(image, 0, 1)) for image in (a, b))
    theirs, mean, settings = evaluator.evaluate(*clamped, "LDR", applyMagma=False)
    assert settings["ppd"] == pytest.approx(constants.FLIP_DEGREE, abs=1e-4)
    (ours,) = flip_maps(open_form("w8"), [(a, b)])
    away = np.abs(ours - theirs[..., 0])
    # Powers below 1 make much of roundings where colours are equal in exact arithmetic, as in a few pixels of "lines".
    assert away.mean() < 2e-5 and away.max() < (1e-2 if name == "lines" else 2e-4)
    assert flips(open_form("w8"), [(a, b)]) == [pytest.approx(mean, abs=1e-4)]


# What flip-evaluator 1.7 gives, for machines that it has no wheels for.
KNOWN = {
    "noise": 0.07996, "views": 0.30320, "blur": 0.04594, "shift": 0.03514, "tint": 0.33641,
    "steps": 0.17123, "lines": 0.78787, "waves": 0.47526, "hardly": 0.00564, "small": 0.13300,
}  # fmt: skip


@pytest.mark.parametrize("name", PAIRS)
def test_flip_is_what_nvidias_program_gave(name: str) -> None:
    assert flips(open_form("w8"), [PAIRS[name]]) == [pytest.approx(KNOWN[name], abs=1e-4)]


@pytest.mark.parametrize(("height", "width"), [(1, 1), (20, 33), (57, 131)])
def test_forms_give_the_same_bits(height: int, width: int) -> None:
    a, b = waves(height, width)
    found = {flip_maps(open_form(form), [(a, b)])[0].tobytes() for form in ALL_FORMS}
    assert len(found) == 1


def test_equal_pictures_have_none_and_the_largest_difference_is_one() -> None:
    a, b = waves(40, 30)
    green, blue = flat((0, 1, 0)), flat((0, 0, 1))
    assert not np.any(flip_maps(open_form("w8"), [(a, a)])[0])
    assert flips(open_form("w8"), [(green, blue)]) == [pytest.approx(1.0, abs=1e-5)]
    (one,), (two,) = (flip_maps(open_form("w8"), [pair]) for pair in ((a, b), (b, a)))
    assert one.tobytes() == two.tobytes(), "the order counts"


def test_pairs_of_the_same_images_are_those_of_each_alone() -> None:
    a, b = waves(50, 40)
    c = np.roll(a, 3, axis=0)
    alone = [flips(open_form("w8"), [pair])[0] for pair in ((a, b), (a, c), (c, b))]
    assert flips(open_form("w8"), [(a, b), (a, c), (c, b)]) == alone


@pytest.mark.parametrize("band", [1, 1000, 4096])
def test_bands_change_no_bit(band: int, monkeypatch: pytest.MonkeyPatch) -> None:
    a, b = waves(61, 45)
    (whole,) = flip_maps(open_form("w8"), [(a, b)])
    monkeypatch.setattr(similarity, "BAND", band)
    (parts,) = flip_maps(open_form("w8"), [(a, b)])
    assert parts.tobytes() == whole.tobytes()


def test_filters_keep_what_is_flat() -> None:
    light, red_green, *blues, smooth, slope, bend = taps().astype(np.float64)
    assert [light.sum(), red_green.sum(), smooth.sum()] == pytest.approx([1.0] * 3, abs=1e-6)
    assert sum(taps.sum() ** 2 for taps in blues) == pytest.approx(1.0, abs=1e-6)
    for filter in (slope, bend):
        assert filter[filter > 0].sum() == pytest.approx(1.0) and filter[filter < 0].sum() == pytest.approx(-1.0)
    # What the loops of the kernels leave out.
    reach = constants.FLIP_REACH - constants.FLIP_FEATURE_REACH
    assert not np.any([filter[:reach] for filter in (smooth, slope, bend)])
    fine = constants.FLIP_REACH - constants.FLIP_FINE_REACH
    assert 0 < light[:fine].sum() < red_green[:fine].sum() < 1e-7


def test_constants_follow_from_the_standards() -> None:
    chromaticities = np.array([[0.64, 0.33], [0.30, 0.60], [0.15, 0.06], [0.3127, 0.3290]])
    xyz = np.array([[x / y, 1.0, (1.0 - x - y) / y] for x, y in chromaticities])
    white = xyz[3]
    matrix = xyz[:3].T * np.linalg.solve(xyz[:3].T, white) / white[:, None]
    assert np.array(constants.FLIP_XYZ).reshape(3, 3) == pytest.approx(matrix, abs=1e-8)
    assert np.array(constants.FLIP_RGB).reshape(3, 3) == pytest.approx(np.linalg.inv(matrix), abs=1e-7)

    def lab(rgb: tuple[float, float, float]) -> np.ndarray:
        t = matrix @ np.array(rgb)
        x, y, z = np.where(t > (6 / 29) ** 3, np.cbrt(t), t / (3 * (6 / 29) ** 2) + 4 / 29)
        lightness = 116 * y - 16
        return np.array([lightness, 5 * lightness * (x - y), 2 * lightness * (y - z)])

    away = lab((0, 1, 0)) - lab((0, 0, 1))
    assert (abs(away[0]) + math.hypot(*away[1:])) ** 0.7 == pytest.approx(constants.FLIP_COLOUR_MOST, abs=1e-5)
    assert pytest.approx(67.0206, abs=1e-4) == constants.FLIP_DEGREE
    assert (constants.FLIP_REACH, constants.FLIP_FEATURE_REACH) == (10, 9)


def test_no_pairs_and_images_of_two_sizes() -> None:
    a, _ = waves(20, 20)
    assert flips(open_form("w8"), []) == []
    with pytest.raises(InputError, match="FLIP"):
        flips(open_form("w8"), [(a, a[:10])])


def test_what_it_takes_is_what_it_says_and_comes_back() -> None:
    a, b = waves(30, 50)
    size = flip_bytes(50, 30, images=2)
    budget = MemoryBudget(size)
    flips(TwinBackend(budget), [(a, b)])
    assert budget.used == 0
    with pytest.raises(BudgetError):
        flips(TwinBackend(MemoryBudget(size * 3 // 4)), [(a, b)])
    assert flip_bytes(10_000, 10_000) < 12 * 2**20
