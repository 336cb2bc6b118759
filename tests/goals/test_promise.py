"""The bounds that stand beside a target: which one decides, what is kept, and what is said."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from flexgs_edge.errors import InputError
from flexgs_edge.goals.promise import (
    SSIM_PER_DB,
    KeptPart,
    MadePoses,
    MeanSsim,
    Promised,
    WorstView,
    in_the_way,
    kept_promise,
    promised,
)
from flexgs_edge.goals.steps import Choice, Step, better
from flexgs_edge.goals.target import MaxDrop, MaxSize, Measurement
from flexgs_edge.quality.psnr import modelled_drop, mse_of_psnr
from flexgs_edge.quality.view_quality import Quality, ViewQuality
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.quality_evaluator import measurement_of

PARTS = (WorstView("drop", 1.7), MeanSsim(0.015), MadePoses())
GOOD = Measurement(0.8, 40.0, 0.8, Measurement(1.3, 38.0, 1.2), usual=0.8, ssim_drop=0.01, made_gap=1.0)


def test_all_parts_hold_or_the_point_misses() -> None:
    target = Promised(MaxDrop(1.0), PARTS)
    assert target.excess(1, GOOD) == pytest.approx(math.log(0.8)) and target.decides(1, GOOD) is None
    for changed, part in (
        ({"worst": Measurement(1.75, 30.0, 1.75)}, PARTS[0]),
        ({"ssim_drop": 0.016}, PARTS[1]),
        ({"made_gap": 3.1}, PARTS[2]),
    ):
        found = replace(GOOD, **changed)
        assert target.excess(1, found) > 0 and target.decides(1, found) == part
        kept = kept_promise(target, 1, found)
        assert kept is not None and not kept.held and kept.decided == part.name
        assert [item.held for item in kept.parts] == [item is not part for item in PARTS]
        assert in_the_way(target, 1, found).startswith(f"the {part.name} stands in the way: ")
        assert part.option in in_the_way(target, 1, found)
    missed = replace(GOOD, drop=1.2)
    assert target.decides(1, missed) is None and in_the_way(target, 1, missed) == ""
    kept = kept_promise(target, 1, missed)
    assert kept is not None and kept.decided == "target" and kept.held


def test_shares_are_what_was_measured_over_what_is_allowed() -> None:
    """A bound follows from the target: what the mean has reached changes nothing."""
    for mean in (0.1, 0.8):
        found = replace(GOOD, usual=mean, drop=mean)
        assert [part.share(found) for part in PARTS] == pytest.approx([1.3 / 1.7, 0.01 / 0.015, 1 / 3])
        assert PARTS[0].excess(found) == pytest.approx(math.log(1.3 / 1.7))
    kept = kept_promise(Promised(MaxDrop(1.0), PARTS), 1, GOOD)
    assert kept is not None and kept.share == pytest.approx(0.8) and kept.parts[0].share == pytest.approx(1.3 / 1.7)


def test_what_was_not_measured_does_not_decide() -> None:
    """Estimates know neither SSIM nor made poses."""
    target = Promised(MaxDrop(1.0), PARTS)
    found = replace(GOOD, ssim_drop=None, made_gap=None)
    assert target.excess(1, found) == target.excess(1, GOOD)
    assert "SSIM" not in target.report(1, found) and "made poses" not in target.report(1, found)
    kept = kept_promise(target, 1, found)
    assert kept is not None
    assert kept.parts[1] == KeptPart("SSIM lost", "SSIM lost - of 0.015", None, 0.015, None, True)
    assert promised(MaxDrop(1.0), ()) == MaxDrop(1.0) and kept_promise(MaxDrop(1.0), 1, GOOD) is None


def test_a_size_holds_whatever_the_promise_says() -> None:
    """Of two files that fit, one that breaks a bound that was set is worse, whatever its mean."""
    target = Promised(MaxSize(1000, "drop"), PARTS)
    broken = replace(GOOD, drop=0.7, worst=Measurement(1.8, 30.0, 1.8), made_gap=5.0)

    def step(measurement: Measurement) -> Step:
        return Step(Choice(0, 0), 900, measurement, target.excess(900, measurement), "list", 0.0)

    assert step(broken).holds and better(step(GOOD), step(broken), target)
    assert not better(step(broken), step(GOOD), target)
    assert better(step(replace(GOOD, drop=0.7)), step(GOOD), target)
    assert in_the_way(target, 900, broken).startswith("the made poses stand")
    # A bound that follows from the mean says less than the mean: one bad view is better than a loss everywhere.
    target = Promised(MaxSize(1000, "drop"), (WorstView("drop"), MadePoses()))
    one, everywhere = (
        Measurement(mean, 30.0, mean, Measurement(worst, 25.0, worst), usual=mean)
        for mean, worst in ((2.0, 4.1), (13.6, 15.6))
    )
    assert target.broken(one) > 0 > target.broken(everywhere) and better(step(one), step(everywhere), target)
    slightly = replace(one, drop=1.9, worst=Measurement(7.0, 20.0, 7.0))
    assert better(step(one), step(slightly), target)


def test_with_a_size_the_worst_view_follows_a_mean_where_gains_count_as_nothing() -> None:
    views = (ViewQuality("a", 1e-4, 2e-3, 1e-3), ViewQuality("b", 1e-4, 0.9e-3, 1e-3))
    found = measurement_of(Quality(views))
    assert (
        found.drop == found.usual == pytest.approx(10 * math.log10(2) / 2) and (Quality(views).drop or 9) < found.usual
    )
    assert WorstView("drop").allowed(found) == pytest.approx(1.5 * found.usual + 0.2)  # type: ignore[operator]
    without = measurement_of(Quality(tuple(ViewQuality(view.name, view.error) for view in views)))
    assert without.usual == pytest.approx(modelled_drop(1e-4))


def test_ssim_and_made_poses_come_from_the_views() -> None:
    views = (ViewQuality("a", 1e-4, 2e-3, 1e-3, ssim_original=0.98, ssim_photo=0.90, original_ssim=0.91),)
    made = Quality((ViewQuality("m", 2e-4),))
    found = measurement_of(Quality(views, made=made))
    assert found.ssim_drop == pytest.approx(0.01) and found.made_gap == pytest.approx(10 * math.log10(2))
    alone = measurement_of(Quality((ViewQuality("a", 1e-4, ssim_original=0.98, coverage=0.5),), covered_decides=True))
    assert alone.ssim_drop == pytest.approx(0.7 * 0.04) and alone.made_gap is None


@pytest.mark.parametrize(
    ("words", "names"),
    [
        ({}, ["worst view", "SSIM lost", "made poses"]),
        ({"promise": "mean"}, []),
        ({"promise": "mean", "max_worst_drop": 2.0}, ["worst view"]),
        ({"promise": "mean", "views_margin": True}, ["made poses"]),
        ({"max_worst_drop": "none"}, ["SSIM lost", "made poses"]),
        ({"max_ssim_drop": "none", "views_margin": False}, ["worst view"]),
        ({"max_size": 1000}, ["worst view", "made poses"]),
        ({"max_size": 1000, "max_ssim_drop": 0.1}, ["worst view", "SSIM lost", "made poses"]),
    ],
)
def test_options_make_the_parts(words: dict[str, Any], names: list[str]) -> None:
    target = CompressOptions(**words).target("drop", 10**6)
    assert [part.name for part in target.parts] == names if isinstance(target, Promised) else names == []


def test_bounds_follow_the_target() -> None:
    def limits(**words: Any) -> list[float]:
        target = CompressOptions(**words).target("drop", 1)
        assert isinstance(target, Promised)
        return [part.allowed(GOOD) for part in target.parts]

    assert limits() == [1.7, SSIM_PER_DB, 3.0] and limits(max_drop=0.5) == [0.95, SSIM_PER_DB / 2, 3.0]
    drop = modelled_drop(mse_of_psnr(38.0))
    assert limits(min_fidelity=38.0) == pytest.approx([1.5 * drop + 0.2, SSIM_PER_DB * drop, 3.0])
    assert limits(max_size=1000) == pytest.approx([1.5 * 0.8 + 0.2, 3.0])
    with pytest.raises(InputError, match="fixed rates leave nothing to search"):
        CompressOptions(method="paper", prune_rate=0.1, sh_rate=0.1, max_ssim_drop=0.01)
