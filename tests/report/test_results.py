"""Result records and the text made from them, on hand-made figures."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from flexgs_edge.quality.view_quality import Quality, ViewQuality
from flexgs_edge.report.as_json import quality_json
from flexgs_edge.report.file_results import DecompressResult, RenderResult
from flexgs_edge.report.results import EvaluateResult
from flexgs_edge.report.run_info import PLY_HEADER_MOST, RunInfo, SceneInfo, ViewsInfo, fields_json
from flexgs_edge.report.summary import ratio_lines

RUN = RunInfo(1.25, {"open": 0.25, "device": 0.5}, 0.5, 0.125, 2**30, 2**28, {"backend": "numpy", "numpy": "2"})
SCENE = SceneInfo("a.ply", 10, 3, 2480, 2360, ("2 of 12 Gaussians left out as invalid",))
VIEWS = ViewsInfo("cameras.json", None, 3, 2, 1, 40, 30, ("3 views scaled down",))


def test_identical_and_missing_figures_are_null() -> None:
    record = quality_json(Quality((ViewQuality("a", 0.0), ViewQuality("b", 1e-3))))
    assert record["views"][0]["fidelity"] is None and record["views"][0]["drop"] is None
    assert record["fidelity"] == 30.0 and record["identical_views"] == 1 and record["psnr"] is None
    assert record["worst"]["name"] == "b"
    json.dumps(record, allow_nan=False)
    assert quality_json(Quality(()))["worst"] is None


def test_evaluate_text_has_a_row_a_view_and_says_identical() -> None:
    quality = Quality((ViewQuality("a", 0.0, 1e-3, 1e-3), ViewQuality("b", 1e-4, 2e-3, 1e-3)))
    text = EvaluateResult(SCENE, SCENE, VIEWS, quality, "held-out", RUN).summary()
    rows = [line.split() for line in text.splitlines()]
    assert ["a", "identical", "identical", "100", "%", "-", "-", "0.000", "30.000", "30.000", *4 * "-"] in rows
    assert ["b", "40.000", "40.000", "100", "%", "-", "-", "3.010", "26.990", "30.000", *4 * "-"] in rows
    for words in (
        "worst view:  b: drop 3.010 dB",
        "1 views identical",
        "left out as invalid",
        "scaled down",
        "no photos",
    ):
        assert words in text


def test_flip_is_said_of_the_mean_and_of_the_view_that_looks_worst() -> None:
    views = (
        ViewQuality("a", 1e-3, 3e-3, 1e-3, flip_original=0.01, flip_photo=0.03, original_flip=0.02),
        ViewQuality("b", 1e-4, 2e-3, 1e-3, flip_original=0.05, flip_photo=0.07, original_flip=0.04),
    )
    result = EvaluateResult(SCENE, SCENE, VIEWS, Quality(views), "held-out", RUN)
    text, record = result.summary(), result.to_json()["quality"]
    assert "FLIP 0.0300 -> 0.0500" in text and ", FLIP 0.0300;" in text
    assert "worst FLIP:  0.0500 against the original's render, b" in text and "worst view:  a" in text
    assert (record["flip"], record["original_flip"], record["flip_fidelity"], record["worst_flip"]) == (
        0.05,
        0.03,
        0.03,
        0.05,
    )
    assert [(view["flip"], view["flip_fidelity"]) for view in record["views"]] == [(0.03, 0.01), (0.07, 0.05)]
    assert (
        "ssim" in record["views"][0]
        and "worst FLIP"
        not in EvaluateResult(SCENE, SCENE, VIEWS, Quality((ViewQuality("b", 1e-4),)), "training", RUN).summary()
    )


def test_without_photos_no_drop_is_claimed() -> None:
    text = EvaluateResult(SCENE, SCENE, VIEWS, Quality((ViewQuality("b", 1e-4),)), "training", RUN).summary()
    assert "against the photos" not in text and "modelled drop" in text and "worst view:  b: fidelity 40.000 dB" in text


@pytest.mark.parametrize(
    ("seconds", "median"), [((), 0.0), ((0.5,), 500.0), ((0.1, 0.9, 0.2), 200.0), ((0.1, 0.3), 200.0)]
)
def test_time_of_a_view_is_the_median_without_start_up(seconds: tuple[float, ...], median: float) -> None:
    result = RenderResult(SCENE, VIEWS, tuple(f"{i}.png" for i in range(len(seconds))), seconds, 9.0, RUN)
    record = result.to_json()
    assert record["ms_per_view"] == pytest.approx(median)
    assert (record["startup_ms"], record["compile_ms"], record["warm_up_ms"]) == (500.0, 125.0, 9000.0)
    assert f"{median:.1f} ms a view" in result.summary() and "NumPy twins" in result.summary()


@pytest.mark.parametrize(
    ("given", "size", "lines"),
    [
        # From memory, and plain PLY files: one number.
        (None, 248_000, ["ratio:       10.00x of the PLY's 2.48 MB (90.0 % smaller)"]),
        (2_480_000 + 1500, 248_000, ["ratio:       10.00x of the PLY's 2.48 MB (90.0 % smaller)"]),
        (2_480_000 + PLY_HEADER_MOST - 1, 248_000, ["ratio:       10.00x of the PLY's 2.48 MB (90.0 % smaller)"]),
        # A PLY without normals, and files of other formats.
        (
            2_360_000,
            248_000,
            [
                "ratio:       9.52x of the input's 2.36 MB (89.5 % smaller)",
                "of a PLY:    10.00x of the PLY's 2.48 MB (90.0 % smaller)",
            ],
        ),
        (
            200_000,
            284_600,
            [
                "ratio:       0.70x of the input's 200.00 kB (42.3 % larger)",
                "of a PLY:    8.71x of the PLY's 2.48 MB (88.5 % smaller)",
            ],
        ),
    ],
)
def test_sizes_are_compared_with_the_input_first(given: int | None, size: int, lines: list[str]) -> None:
    scene = replace(SCENE, count=10_000, ply_bytes=2_480_000, bytes=given)
    assert ratio_lines(scene, size) == lines
    assert fields_json(scene)["bytes"] == given
    assert scene.ratio_of(size) == (None if given is None else given / size)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (500, "4.96 times larger than the input's 500 B"),
        (4960, "2.00 times smaller"),
        (2480, "as large as the input's 2.48 kB"),
        (None, None),
    ],
)
def test_a_decoded_file_is_compared_with_the_input(given: int | None, words: str | None) -> None:
    result = DecompressResult(replace(SCENE, bytes=given), "a.ply", 2480, RUN)
    assert ("size:" in result.summary()) == (words is not None) and (words or "") in result.summary()
    assert result.to_json()["ratio_of_input"] == (None if given is None else round(given / 2480, 4))
