"""Opening model folders, and finding what lies beside scenes."""

from __future__ import annotations

from pathlib import Path

import pytest

from flexgs_edge.errors import FormatError
from flexgs_edge.io.model_folder import find_companions
from scene_files import open_scene, random_rows, write_rows


@pytest.fixture
def model(tmp_path: Path) -> Path:
    for iteration, count in ((7000, 2), (30000, 3), (900, 1)):
        folder = tmp_path / "point_cloud" / f"iteration_{iteration}"
        folder.mkdir(parents=True)
        write_rows(folder / "point_cloud.ply", random_rows(count))
    (tmp_path / "point_cloud" / "iteration_best").mkdir()
    (tmp_path / "point_cloud" / "iteration_99999").mkdir()  # without a scene in it
    return tmp_path


def test_a_model_folder_gives_its_latest_iteration_by_number(model: Path) -> None:
    source = open_scene(model)
    assert source.count == 3 and "iteration_30000" in source.name


def test_a_folder_with_a_point_cloud_gives_it(tmp_path: Path) -> None:
    write_rows(tmp_path / "point_cloud.ply", random_rows(2))
    (tmp_path / "point_cloud").mkdir()
    assert open_scene(tmp_path).count == 2


def test_companions_beside_a_ply(tmp_path: Path) -> None:
    found = find_companions(tmp_path / "a.ply")
    assert (found.cameras, found.images, found.white_background) == (None, None, None)
    (tmp_path / "cameras.json").touch()
    (tmp_path / "images").mkdir()
    found = find_companions(tmp_path / "a.ply")
    assert (found.cameras, found.images) == (tmp_path / "cameras.json", tmp_path / "images")


def test_companions_of_a_bare_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "cameras.json").touch()
    monkeypatch.chdir(tmp_path)
    assert find_companions("a.ply").cameras == Path("cameras.json")


def test_companions_of_a_model_folder_and_of_a_ply_inside_it(model: Path) -> None:
    (model / "cameras.json").touch()
    photos = model / "data" / "images_4"
    photos.mkdir(parents=True)
    (model / "cfg_args").write_text(
        f"Namespace(data_device='cuda', eval=True, images='images_4', sh_degree=3, source_path={str(model / 'data')!r}, "
        "white_background=True)"
    )
    for path in (model, model / "point_cloud" / "iteration_7000" / "point_cloud.ply"):
        found = find_companions(path)
        assert (found.cameras, found.images, found.white_background) == (model / "cameras.json", photos, True)


@pytest.mark.parametrize(
    ("words", "antialiased"), [("antialiasing=True", True), ("antialiasing=False", False), ("antialiasing='yes'", None)]
)
def test_cfg_args_may_say_that_the_model_is_antialiased(model: Path, words: str, antialiased: bool | None) -> None:
    assert find_companions(model).antialiased is None
    (model / "cfg_args").write_text(f"Namespace({words})")
    assert find_companions(model).antialiased is antialiased


def test_photos_beside_the_model_when_the_source_path_is_elsewhere(model: Path) -> None:
    (model / "images").mkdir()
    (model / "cfg_args").write_text("Namespace(images='images', source_path='/no/such/place', white_background=False)")
    found = find_companions(model)
    assert (found.images, found.white_background) == (model / "images", False)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "Namespace(",
        "__import__('os').system('touch hacked')",
        "[1]",
        "a.b(c=1)",
        "(" * 5000,
        "\0",
        "Namespace(a=1) + 2",
    ],
)
def test_a_cfg_args_that_is_no_namespace(model: Path, text: str) -> None:
    (model / "cfg_args").write_text(text)
    with pytest.raises(FormatError, match=r"cfg_args: expected the text Namespace"):
        find_companions(model)


def test_nothing_in_cfg_args_is_evaluated(model: Path) -> None:
    (model / "cfg_args").write_text("Namespace(white_background=print('hacked'), images=[1], source_path=3, **x)")
    found = find_companions(model)
    assert (found.images, found.white_background) == (None, None)


def test_a_cfg_args_that_is_not_text(model: Path) -> None:
    (model / "cfg_args").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FormatError, match="cfg_args"):
        find_companions(model)
