"""Figures over the part of the pictures that the original covers: their arithmetic, and when they decide."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flexgs_edge.goals.promise import Promised, WorstView
from flexgs_edge.goals.target import Covered, MaxDrop, MaxSize, Measurement, MinFidelity
from flexgs_edge.quality.psnr import modelled_drop, mse
from flexgs_edge.quality.view_quality import LEAST_COVERAGE, Quality, ViewQuality, compare_view
from flexgs_edge.report.as_json import quality_json
from flexgs_edge.report.summary import quality_lines
from flexgs_edge.run.quality_evaluator import measurement_of

SMALL = Quality((ViewQuality("a", 1e-5, coverage=0.01), ViewQuality("b", 4e-5, coverage=0.02)), 34.0, True)


@pytest.mark.parametrize("empty", [0, 30, 300])
def test_empty_pixels_do_not_dilute(empty: int) -> None:
    """An object on its own, and the same one beside empty background."""
    rng = np.random.default_rng(1)
    image, original = rng.uniform(0, 1, (2, 10, 10, 3)).astype(np.float32)
    padding = np.zeros((10, empty, 3), np.float32)
    wide = [np.concatenate([part, padding], axis=1) for part in (image, original)]
    view = compare_view("a", *wide, coverage=10 / (10 + empty))
    assert view.covered_error == pytest.approx(mse(image, original), rel=1e-9)
    assert view.error == pytest.approx(mse(image, original) * view.coverage)


def test_errors_outside_the_silhouette_count() -> None:
    original = np.zeros((10, 10, 3), np.float32)
    original[:5] = 0.5
    image = original.copy()
    image[7] = 0.5  # where the original is empty
    assert compare_view("a", image, original, coverage=0.5).covered_error == pytest.approx(0.25 * 10 / 50)


def test_a_full_picture_has_equal_figures() -> None:
    quality = Quality((ViewQuality("a", 1e-4), ViewQuality("b", 3e-4)), 34.0)
    assert quality.coverage == 1.0 and quality.covered_error == quality.error
    assert quality.covered_fidelity == pytest.approx(quality.fidelity)
    assert quality.covered_modelled_drop == quality.modelled_drop


def test_views_count_by_what_they_see() -> None:
    assert SMALL.covered_error == pytest.approx(5e-5 / 0.03)
    each = [view.covered_fidelity or 0 for view in SMALL.views]
    assert each == [pytest.approx(30.0), pytest.approx(26.9897, abs=1e-4)]
    assert SMALL.covered_fidelity == pytest.approx((each[0] + 2 * each[1]) / 3)
    # A faint pixel in an empty view must not decide, and an empty view cannot.
    faint, empty = ViewQuality("c", 1e-8, coverage=1e-9), ViewQuality("d", 0.0, coverage=0.0)
    more = replace(SMALL, views=(*SMALL.views, faint, empty))
    assert faint.covered_error == pytest.approx(10) and (empty.covered_error, empty.covered_fidelity) == (None, None)
    assert more.covered_fidelity == pytest.approx(SMALL.covered_fidelity, abs=1e-4)
    assert more.covered_error == pytest.approx(SMALL.covered_error, rel=1e-3)
    assert more.worst is more.views[1] and more.by_loss == [1, 0, 2, 3]


def test_the_worst_view_by_covered_error() -> None:
    small, large = ViewQuality("small", 1e-5, coverage=0.01), ViewQuality("large", 5e-5, coverage=0.9)
    quality = Quality((large, small), covered_decides=True)
    assert LEAST_COVERAGE * quality.coverage > 0.01 and quality.worst is large
    some = replace(small, coverage=0.1, error=1e-4)
    assert Quality((large, some), covered_decides=True).worst is some
    assert replace(quality, covered_decides=False).worst is large


def test_identical_renders_have_no_covered_fidelity() -> None:
    quality = Quality((ViewQuality("a", 0.0, coverage=0.2), ViewQuality("b", 0.0, coverage=0.0)), 34.0, True)
    assert (quality.covered_fidelity, quality.covered_modelled_drop) == (None, 0.0)


def test_which_figures_decide() -> None:
    """Without photos those over covered pixels; with photos the plain ones, also where training poses decide."""
    found = measurement_of(SMALL)
    assert found.fidelity == SMALL.fidelity and found.modelled_drop == SMALL.modelled_drop
    assert found.covered == Covered(SMALL.covered_fidelity, SMALL.covered_modelled_drop)
    assert found.figure("fidelity") == SMALL.covered_fidelity and found.loss("fidelity") == -(
        SMALL.covered_fidelity or 0
    )
    assert found.figure("modelled drop") == found.loss("modelled drop") == SMALL.covered_modelled_drop
    assert found.worst is not None and found.worst.covered is not None
    assert found.worst.covered.modelled_drop == pytest.approx(modelled_drop(2e-3, 34.0))
    plain = measurement_of(replace(SMALL, covered_decides=False))
    assert plain.covered is None and plain.figure("fidelity") == SMALL.fidelity
    assert plain.loss("modelled drop") == SMALL.modelled_drop


def test_targets_ask_the_figures_that_decide() -> None:
    inner = Measurement(None, 60.0, 0.01, covered=Covered(20.0, 12.0))
    found = Measurement(None, 70.0, 0.001, inner, Covered(30.0, 3.0))
    assert MinFidelity(40.0).excess(1, found) > 0 and MaxDrop(1.0, "modelled drop").excess(1, found) > 0
    assert MinFidelity(25.0).excess(1, found) < 0 and "fidelity 30.000 dB" in MinFidelity(25.0).report(1, found)
    worst = Promised(MinFidelity(25.0), (WorstView("modelled drop", 1.5),))
    assert worst.excess(1, found) > 0 and "worst view 12.000 of 1.500 dB" in worst.report(1, found)
    assert "modelled drop 3.000 dB" in MaxSize(10).report(1, found)


def test_both_figures_are_shown() -> None:
    text = "\n".join(quality_lines(SMALL, "2 views"))
    assert "fidelity:    46.990 dB" in text and "b: fidelity 43.979 dB, 26.990 dB covered" in text
    assert "covered:     fidelity 27.993 dB, modelled drop 7.149 dB" in text and "(1.5 %)" in text
    record = quality_json(SMALL)
    assert (record["fidelity"], record["covered_fidelity"], record["coverage"]) == (46.9897, 27.9931, 0.015)
    assert record["covered_decides"] is True and record["views"][1]["covered_fidelity"] == 26.9897
