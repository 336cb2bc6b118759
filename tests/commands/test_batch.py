"""Which scenes the inputs of a batch stand for, and how their files are called."""

from __future__ import annotations

import itertools
import logging
import os
from pathlib import Path

import pytest

from flexgs_edge.commands.compress_all import (
    check_place,
    is_batch,
    output_names,
    output_suffix,
    scenes_of,
    single_output,
)
from flexgs_edge.errors import InputError


def touch(folder: Path, *names: str) -> Path:
    """Empty files; what a scene holds does not matter here."""
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    return folder


@pytest.fixture
def scans(tmp_path: Path) -> Path:
    """A folder with scenes of every kind, and with what is none."""
    return touch(
        tmp_path / "scans",
        "b.ply", "a.PLY", "c.compressed.ply", "d.spz.gz", "e.fgs", ".hidden.ply", "notes.txt", "x-meta.json",
        "cameras.json", "transforms.json", "images/v.png", "old/f.ply",
        "garden/point_cloud/iteration_7/point_cloud.ply", "pictures/meta.json", "streamed/lod-meta.json",
    )  # fmt: skip


def test_a_folder_stands_for_the_scenes_in_it(scans: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, "flexgs_edge"):
        found = scenes_of([scans, scans / "b.ply", scans / "none.ply"], "out", ".fgs")
    names = ["a.PLY", "b.ply", "c.compressed.ply", "d.spz.gz", "e.fgs", "garden", "pictures", "streamed", "none.ply"]
    assert found == [str(scans / name) for name in names]
    (said,) = (record.getMessage() for record in caplog.records)
    assert said == f"{scans}: skipped notes.txt, old, x-meta.json"


def test_a_folder_with_a_point_cloud_is_a_scene(tmp_path: Path) -> None:
    touch(tmp_path, "fox/point_cloud.ply", "fox/cameras.json", "fox/scene.fgs", "room/point_cloud.ply", "room/b.spz")
    fox, room = tmp_path / "fox", tmp_path / "room"
    assert not is_batch([fox], fox / "scene.fgs") and is_batch([room], "out")
    assert scenes_of([tmp_path], "out", ".fgs") == [str(fox)]
    assert scenes_of([room], "out", ".fgs") == [str(room / "b.spz"), str(room / "point_cloud.ply")]
    assert output_names([str(fox)], ".fgs") == ["fox.fgs"]
    check_place(fox)


def test_many_skipped_files_are_one_line(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    touch(tmp_path, "a.ply", *(f"{k}.txt" for k in range(8)))
    with caplog.at_level(logging.INFO, "flexgs_edge"):
        assert len(scenes_of([tmp_path], None, ".fgs")) == 1
    assert caplog.messages == [f"{tmp_path}: skipped 0.txt, 1.txt, 2.txt, 3.txt, 4.txt and 3 more"]


def test_the_folder_of_the_output_does_not_stand_for_its_outputs(scans: Path) -> None:
    assert str(scans / "e.fgs") not in scenes_of([scans], f"{scans}/", ".fgs")
    assert str(scans / "e.fgs") in scenes_of([scans], f"{scans}/", ".spz")
    assert str(scans / "e.fgs") in scenes_of([scans / "e.fgs"], f"{scans}/", ".fgs")


def test_what_is_a_batch(scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    scene, model = scans / "b.ply", scans / "garden"
    for inputs, output in (
        ([scene, model], "out"),
        ([scene, scene], None),
        ([scans], "out"),
        ([scans], None),
        ([scene], "out/"),
        ([scene], "empty"),
        (["none.ply"], Path("empty")),
    ):
        assert is_batch(inputs, output), (inputs, output)
    for inputs, output in (
        ([scene], "a.fgs"),
        ([scene], None),
        ([model], "out"),
        ([scans / "pictures"], "a.fgs"),
        (["none.ply"], "a.fgs"),
        (["empty"], "a.fgs"),
    ):
        assert not is_batch(inputs, output), (inputs, output)


def test_a_folder_without_scenes_says_what_is_expected(scans: Path, tmp_path: Path) -> None:
    assert scenes_of([scans / "images"], None, ".fgs") == [str(scans / "images")]
    with pytest.raises(InputError, match=r"images: no scene .*\.ply.*iteration_\*"):
        check_place(scans / "images")
    for place in (scans / "garden", scans / "b.ply", scans / "none.ply"):
        check_place(place)


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may list every folder")
def test_a_folder_that_cannot_be_listed(tmp_path: Path) -> None:
    place = tmp_path / "closed"
    place.mkdir(0o000)
    assert scenes_of([place], None, ".fgs") == [str(place)]
    with pytest.raises(InputError, match="cannot list the folder"):
        check_place(place)


def test_files_are_named_after_their_scenes(scans: Path) -> None:
    scenes = [str(scans / name) for name in ("b.ply", "a.PLY", "c.compressed.ply", "d.spz.gz", "garden")]
    assert output_names([*scenes, str(scans / "pictures" / "meta.json")], ".spz") == [
        "b.spz",
        "a.spz",
        "c.spz",
        "d.spz",
        "garden.spz",
        "pictures.spz",
    ]
    assert output_names(["garden.v2/x.y.ply"], ".fgs") == ["x.y.fgs"]


def test_names_that_clash_keep_what_tells_them_apart(tmp_path: Path) -> None:
    expected = {
        "a/x.ply": "a-x.ply.fgs",
        "b/x.ply": "b-x.ply.fgs",
        "b/x.spz": "x.spz.fgs",
        "b/y.ply": "y.fgs",
        "one/p/q.ply": f"{tmp_path.name}-one-p-q.ply.fgs",
        "two/p/q.ply": "two-p-q.ply.fgs",
        # This is what the other one of that name would have been told apart by.
        "one-p-q.ply.ply": "one-p-q.ply.ply.fgs",
    }
    for order in itertools.islice(itertools.permutations(expected), 0, 5040, 97):
        names = output_names([str(tmp_path / name) for name in order], ".fgs")
        assert dict(zip(order, names, strict=True)) == expected
    assert output_names(["r1/garden", "r2/garden"], ".fgs") == ["r1-garden.fgs", "r2-garden.fgs"]


def test_formats_by_name() -> None:
    assert [output_suffix(word) for word in (None, "fgs", ".FGS", "spz", ".compressed.ply")] == [
        ".fgs",
        ".fgs",
        ".fgs",
        ".spz",
        ".compressed.ply",
    ]
    for word in ("ply", ".ksplat", "", "meta.json"):
        with pytest.raises(InputError, match=r"--format .*expected one of \.fgs, "):
            output_suffix(word)


def test_the_format_of_a_single_file_must_agree() -> None:
    assert single_output("a.fgs", None, False) == "a.fgs" and single_output(None, None, True) is None
    assert single_output("a.SPZ", "spz", False) == "a.SPZ"
    assert single_output(None, "spz", True) == "scene.spz" and single_output(None, "spz", False) is None
    with pytest.raises(InputError, match=r"--format spz with -o a\.fgs"):
        single_output("a.fgs", "spz", False)
