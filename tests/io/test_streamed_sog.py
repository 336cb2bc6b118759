"""Streamed SOG scenes: levels, ranges of several files, and what is missing."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexgs_edge.errors import FormatError, InputError
from flexgs_edge.io.exchange import read_foreign
from flexgs_edge.io.reading import Reading
from flexgs_edge.scene.fields import FIELD
from scene_files import open_scene
from sog_files import entry, write_streamed

FINEST = "level of detail 1 of 3, the finest that is there; coarser ones: --lod 2"


def values(place: Path, rows: slice) -> dict[str, np.ndarray]:
    return read_foreign(place).read(rows, list(FIELD))


def test_a_level_is_gathered_from_ranges(tmp_path: Path) -> None:
    """In the order of the leaves, with the environment behind them, and SH of a lower degree padded."""
    source = read_foreign(write_streamed(tmp_path))
    assert (source.count, source.sh_degree, source.notes) == (4 + 7 + 6 + 3, 2, (FINEST,))
    planes = source.read(slice(0, source.count), list(FIELD))
    at = 0
    for folder, rows in (("1_0", slice(8, 12)), ("1_1", slice(0, 7)), ("1_0", slice(0, 6)), ("env", slice(0, 3))):
        part = values(tmp_path / folder / "meta.json", rows)
        here = slice(at, at + rows.stop - rows.start)
        for field in ("means", "quats", "sh_dc", "log_scales", "opacity_logits"):
            np.testing.assert_array_equal(planes[field][:, here], part[field])
        rest = planes["sh_rest"].reshape(3, 8, -1)[:, :, here]
        inner = part["sh_rest"].reshape(3, -1, here.stop - here.start)
        np.testing.assert_array_equal(rest[:, : inner.shape[1]], inner)
        assert not rest[:, inner.shape[1] :].any()
        at = here.stop
    some = np.array([0, 3, 4, 12, 16, 19])
    for field, plane in source.read(some, list(FIELD)).items():
        np.testing.assert_array_equal(plane, planes[field][:, some])


def test_levels_that_are_asked_for(tmp_path: Path) -> None:
    place = write_streamed(tmp_path)
    coarse = open_scene(tmp_path, Reading(lod=2))
    assert (coarse.count, coarse.sh_degree, coarse.notes) == (5 + 3, 0, ())
    with pytest.raises(
        InputError, match=r"--lod 0: '0_0/meta.json' is not there; levels whose files are all there: 1, 2"
    ):
        read_foreign(place, Reading(lod=0))
    with pytest.raises(InputError, match="--lod 3: there is no such level; levels whose files are all there: 1, 2"):
        read_foreign(place, Reading(lod=3))
    shutil.rmtree(tmp_path / "1_1")
    assert read_foreign(place).notes == ("level of detail 2 of 3, the finest that is there",)
    shutil.rmtree(tmp_path / "env")
    assert read_foreign(place).notes[1:] == ("the environment 'env/meta.json' is not there: left out",)
    shutil.rmtree(tmp_path / "2_0")
    with pytest.raises(FormatError, match="expected a level whose files are all there, found no file '0_0/meta.json'"):
        read_foreign(place)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"version": 2}, "version: expected a whole number from 1 to 1, found 2"),
        ({"lodLevels": 0}, "lodLevels: expected a whole number from 1 to 64"),
        ({"filenames": []}, "filenames: expected a list of file names"),
        ({"filenames": 7}, "filenames: expected a list of file names, found 7"),
        ({"filenames": ["../a/meta.json"] * 4}, "'../a/meta.json': expected the name of a file in its folder or below"),
        ({"environment": 3}, "environment: expected a string, found 3"),
        ({"tree": None}, "tree: expected an object, found None"),
        ({"tree": {}}, "tree: expected a node with lods or a list of children"),
        ({"tree": {"children": [{"children": [1]}]}}, r"tree.children\[0\].children\[0\]: expected an object, found 1"),
        ({"tree": {"children": []}}, "found a tree whose leaves have no level"),
        ({"tree": {"lods": {"one": entry(1, 0, 1)}}}, "tree.lods: expected levels 0 to 2, found 'one'"),
        ({"tree": {"lods": {"3": entry(1, 0, 1)}}}, "expected levels 0 to 2, found '3'"),
        ({"tree": {"lods": {"1": entry(4, 0, 1)}}}, "tree.lods.1.file: expected a whole number from 0 to 3, found 4"),
        ({"tree": {"lods": {"1": {"file": 1}}}}, "tree.lods.1.count: expected a whole number"),
        ({"tree": {"lods": {"1": entry(1, 5, 8)}}}, "expected 12 rows at most, found rows 5 to 13 of 1_0/meta.json"),
        (
            {"tree": {"children": [{"lods": {"1": entry(1, 0, 5)}}, {"lods": {"1": entry(1, 4, 5)}}]}},
            "expected each row in one leaf, found rows 4 to 9 of 1_0/meta.json where others end at 5",
        ),
    ],
)  # fmt: skip
def test_wrong_fields_are_named(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    place = write_streamed(tmp_path)
    place.write_text(json.dumps(json.loads(place.read_bytes()) | change))
    with pytest.raises(FormatError, match=f"lod-meta.json: .*{words}"):
        read_foreign(place)


def test_damage_inside_is_placed(tmp_path: Path) -> None:
    place = write_streamed(tmp_path)
    (tmp_path / "1_1" / "quats.webp").write_bytes(b"RIFF")
    with pytest.raises(FormatError, match="lod-meta.json: 1_1/meta.json: quats.webp: expected a WebP or PNG picture"):
        read_foreign(place)


def test_wild_scene(wild: Path) -> None:
    place = wild / "pc-playbot" / "lod-meta.json"
    source = read_foreign(place)
    assert (source.count, source.notes) == (
        125_000,
        ("level of detail 2 of 7, the finest that is there; coarser ones: --lod 3, 4, 5, 6",),
    )
    level, robot = read_foreign(place, Reading(lod=5)), read_foreign(wild / "playbot5.sog")
    for field, plane in level.read(slice(0, 3000), list(FIELD)).items():
        np.testing.assert_array_equal(plane, robot.read(slice(0, 3000), [field])[field])
    with pytest.raises(InputError, match="levels whose files are all there: 2, 3, 4, 5, 6"):
        read_foreign(place, Reading(lod=0))
