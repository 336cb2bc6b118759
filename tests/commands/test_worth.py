"""`info --errors`: every channel's worth is that of a file which really lacks it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexgs_edge.cli import app
from flexgs_edge.codec.open_fgs import open_fgs
from flexgs_edge.codec.v1.container import write_container
from flexgs_edge.codec.v2.container import write_grid
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.commands.evaluate import evaluate
from flexgs_edge.commands.info import info
from flexgs_edge.commands.reduced import DROPPED, ONE_LESS, reduced_scenes
from flexgs_edge.commands.worth import worth
from flexgs_edge.errors import InputError
from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.grid.to_grid import to_grid
from flexgs_edge.packed.quantize import quantize_scene
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource, SceneSource
from synthetic import random_scene
from tiny_project import write_cameras

COUNT, DEGREE = 400, 2
STEPS = StepSizes(2**-6, 2**-3, 2**-6, 2**-2, 2**-4, (2**-4, 2**-4))
"""Powers of two: of a value and twice the step, both ways there and back are exact."""
VIEWS: dict[str, Any] = {"resolution": 24}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One scene as files of both versions, with cameras beside them."""
    place = tmp_path_factory.mktemp("worth")
    planes = read(random_scene(COUNT, 3, DEGREE, size=-3))
    planes["quats"][1:] *= 0.05  # far from where an axis would be named otherwise, coded again
    planes["quats"][0] = 1
    degrees = np.random.default_rng(1).integers(0, DEGREE + 1, COUNT)
    write_grid(place / "2.fgs", to_grid(planes, degrees, STEPS, np.zeros(3))[0], {})
    rows = np.arange(COUNT)
    write_container(place / "1.fgs", quantize_scene(MemorySource(planes), rows[:80], rows[80:]), {})
    write_cameras(place / "cameras.json", 6)
    return place


@pytest.fixture(scope="module")
def found(folder: Path) -> dict[str, dict[str, Any]]:
    return {name: worth(folder / name, **VIEWS).to_json() for name in ("1.fgs", "2.fgs")}


def read(source: SceneSource) -> dict[str, np.ndarray]:
    return source.read(slice(0, source.count), list(FIELD))


def item(found: dict[str, Any], channel: str, change: str) -> dict[str, Any]:
    (one,) = (i for i in found["errors"]["changes"] if (i["channel"], i["change"]) == (channel, change))
    return one


CASES = [
    ("position", ONE_LESS, {"position": 2 * STEPS.position}, DEGREE),
    ("dc", ONE_LESS, {"dc": 2 * STEPS.dc}, DEGREE),
    ("sh 2", ONE_LESS, {"sh": (STEPS.sh[0], 2 * STEPS.sh[1])}, DEGREE),
    ("sh 1", DROPPED, {}, 0),
    ("sh 2", DROPPED, {}, 1),
]


@pytest.mark.parametrize(("channel", "change", "steps", "degree"), CASES, ids=lambda value: str(value)[:12])
def test_it_is_that_of_a_file_without(
    folder: Path, tmp_path: Path, found: dict[str, dict[str, Any]], channel: str, change: str, steps: dict[str, Any],
    degree: int,
) -> None:  # fmt: skip
    """The decoded values put on the coarser grid, written, and measured by `evaluate`."""
    source = GridSource(folder / "2.fgs")
    degrees = np.minimum(source.grid().sh_degrees, degree)
    grid, _ = to_grid(read(source), degrees, replace(STEPS, **steps), source.origin)
    size = write_grid(tmp_path / "less.fgs", grid, {})
    quality = evaluate(tmp_path / "less.fgs", folder / "2.fgs", **VIEWS).quality
    one = item(found["2.fgs"], channel, change)
    assert one["bytes_saved"] > 0 and one["bytes_saved"] == found["2.fgs"]["size"] - size
    assert quality.coverage < 0.9 and quality.covered_fidelity == pytest.approx(one["fidelity"], abs=1e-4)
    assert quality.covered_modelled_drop == pytest.approx(one["modelled_drop"], abs=1e-6)


@pytest.mark.parametrize("version", [1, 2])
def test_less_saves_more_and_costs_more(found: dict[str, dict[str, Any]], version: int) -> None:
    record = found[f"{version}.fgs"]
    changes = record["errors"]["changes"]
    assert {i["channel"] for i in changes} >= set(record["channels"]) - {"sh degree"}
    for one in (i for i in changes if i["change"] == ONE_LESS and i["channel"] not in ("position", "xyz")):
        gone = item(record, one["channel"], DROPPED)
        assert gone["bytes_saved"] > one["bytes_saved"] > 0, one
        assert gone["fidelity"] < one["fidelity"] and gone["modelled_drop"] > one["modelled_drop"] > 0, one
    rest = ("rest", "rest from 2") if version == 1 else ("sh 1", "sh 2")
    all_of_it, part = (item(record, channel, DROPPED) for channel in rest)
    assert all_of_it["bytes_saved"] > part["bytes_saved"] and all_of_it["fidelity"] < part["fidelity"]


def test_version_1_saves_what_its_arrays_take(folder: Path, found: dict[str, dict[str, Any]]) -> None:
    record = found["1.fgs"]
    opacity, rest = record["channels"]["opacity"], record["channels"]["rest"]
    assert item(record, "opacity", DROPPED)["bytes_saved"] == opacity["bytes"]
    assert item(record, "opacity", ONE_LESS)["bytes_saved"] == COUNT * 4 // 8 - (COUNT * 3 + 7) // 8
    assert item(record, "rest", DROPPED)["bytes_saved"] == rest["bytes"]
    assert item(record, "rest from 2", DROPPED)["bytes_saved"] == rest["bytes"] * 15 // 24, "15 of 24 coefficients"
    lessers = {(one.channel, one.change): one for one in reduced_scenes(open_fgs(folder / "1.fgs"))}
    old, new = read(open_fgs(folder / "1.fgs")), read(lessers["rest from 2", DROPPED].make()[1])
    np.testing.assert_array_equal(new["sh_rest"].reshape(3, 3, COUNT), old["sh_rest"].reshape(3, 8, COUNT)[:, :3])
    # The highest code has no higher one to round to.
    logits = read(open_fgs(folder / "1.fgs"))["opacity_logits"][0]
    step = np.diff(np.unique(logits)).min()
    coarser = read(lessers["opacity", ONE_LESS].make()[1])["opacity_logits"][0]
    assert logits.argmax() in np.flatnonzero(coarser == coarser.max()) and abs(coarser - logits).max() < 1.01 * step
    flat = read(lessers["dc", DROPPED].make()[1])["sh_dc"]
    np.testing.assert_allclose(flat, np.repeat(old["sh_dc"].mean(axis=1, keepdims=True), COUNT, axis=1), atol=1e-6)


def test_on_the_command_line(
    folder: Path, tmp_path: Path, found: dict[str, dict[str, Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib", reason="the extra [charts] is not installed")
    command = ["info", folder / "1.fgs", "--errors", "--resolution", 24, "-q"]

    def run(*arguments: object) -> int:
        with pytest.raises(SystemExit) as left:
            app.main([str(argument) for argument in arguments])
        return int(str(left.value.code))

    assert run(*command, "--picture", tmp_path / "a.svg", "--json", tmp_path / "a.json") == 0
    record = json.loads((tmp_path / "a.json").read_text())
    text = capsys.readouterr().out
    assert text == worth(folder / "1.fgs", **VIEWS).summary() and "on 1 held-out view of" in text
    assert record == json.loads(json.dumps(found["1.fgs"]))
    plain = json.loads(json.dumps(info(folder / "1.fgs").to_json()))
    assert {name: record[name] for name in plain} == plain
    assert b"<svg" in (tmp_path / "a.svg").read_bytes()
    for wrong, words in (
        (["--picture", tmp_path / "a.gif"], ".png or .svg"),
        (["--picture", tmp_path / "a.svg"], "-f to overwrite"),
        (["--cameras", "none"], "--cameras none leaves no views"),
    ):
        assert run(*command, *wrong) == 2 and words in capsys.readouterr().err
    assert run("info", folder / "1.fgs", "--holdout", 3) == 2 and "add --errors" in capsys.readouterr().err


def test_what_has_no_bits_to_take_away(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"needs a \.fgs file"):
        worth(tmp_path / "a.ply")
    nothing = {name: np.zeros((field.width(0), 0), np.float32) for name, field in FIELD.items()}
    write_grid(tmp_path / "a.fgs", to_grid(nothing, np.zeros(0), STEPS, np.zeros(3))[0], {})
    with pytest.raises(InputError, match="no Gaussians"):
        worth(tmp_path / "a.fgs")
