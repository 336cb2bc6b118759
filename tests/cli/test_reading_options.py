"""--frame, --sh-degree and --lod on every command that reads a scene, and commands on files that are no scene."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks.camera_files import inria_json
from flexgs_edge.api.scene import Scene
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.cli import app
from flexgs_edge.errors import InputError
from flexgs_edge.io.frames import RUB, FrameSource
from flexgs_edge.io.ply import PlySource, write_ply
from flexgs_edge.run.inputs import load_scene
from flexgs_edge.run.run import frame_warnings
from flexgs_edge.run.view_set import ViewSet
from synthetic import make_camera
from tiny_project import COUNT, make_project

COMPRESS = ("--method", "paper", "--prune-rate", "0.5", "--sh-rate", "0.5")


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny scene, and `rub.ply` beside it: the same in the frame RUB. Two cameras."""
    folder = make_project(tmp_path_factory.mktemp("tiny") / "scene", photos=False)
    write_ply(folder / "rub.ply", FrameSource(PlySource(folder / "point_cloud.ply"), RUB))
    cameras = [replace(camera, name=f"v{i}") for i, camera in enumerate(read_cameras(folder / "cameras.json")[:2])]
    (folder / "cameras.json").write_text(inria_json(cameras))
    return folder


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as left:
        app.main([*map(str, arguments), "-q"])
    assert isinstance(left.value.code, int)
    return left.value.code


def record(path: Path) -> dict[str, object]:
    found: dict[str, object] = json.loads(path.read_text())
    return found


def test_decompress(project: Path, tmp_path: Path) -> None:
    given = PlySource(project / "point_cloud.ply")
    out = tmp_path / "a.ply"
    assert run("decompress", project / "rub.ply", "-o", out, "--frame", "rub") == 0
    assert out.read_bytes() == (project / "point_cloud.ply").read_bytes()
    assert run("decompress", project / "point_cloud.ply", "-o", out, "--sh-degree", 0, "-f") == 0
    flat = PlySource(out)
    assert flat.sh_degree == 0 and flat.count == COUNT
    np.testing.assert_array_equal(
        flat.read(slice(0, COUNT), ["sh_dc"])["sh_dc"], given.read(slice(0, COUNT), ["sh_dc"])["sh_dc"]
    )


def test_render(project: Path, tmp_path: Path) -> None:
    words = ("--cameras", project / "cameras.json", "--views", "0")
    for name, scene, more in (
        ("plain", "point_cloud.ply", ()),
        ("turned", "rub.ply", ("--frame", "RUB")),
        ("wrong", "rub.ply", ()),
        ("flat", "point_cloud.ply", ("--sh-degree", "0")),
    ):
        assert run("render", project / scene, "-o", tmp_path / name, *words, *more) == 0
    pictures = {
        name: np.asarray(Image.open(tmp_path / name / "v0.png")) for name in ("plain", "turned", "wrong", "flat")
    }
    np.testing.assert_array_equal(pictures["plain"], pictures["turned"])
    for name in ("wrong", "flat"):
        assert (pictures["plain"] != pictures[name]).mean() > 0.1


def test_evaluate(project: Path, tmp_path: Path) -> None:
    """It names the frame of the scene that the cameras belong to."""
    words = ("--holdout", "0", "--frame", "RUB", "--json", tmp_path / "a.json", "-f")
    assert run("evaluate", project / "point_cloud.ply", "--against", project / "rub.ply", *words) == 0
    assert record(tmp_path / "a.json")["quality"]["fidelity"] is None  # type: ignore[index]


def test_compress(project: Path, tmp_path: Path) -> None:
    for name, scene, more in (
        ("plain", "point_cloud.ply", ()),
        ("turned", "rub.ply", ("--frame", "RUB")),
        ("flat", "point_cloud.ply", ("--sh-degree", "0")),
    ):
        words = ("--json", tmp_path / f"{name}.json", *COMPRESS, *more)
        assert run("compress", project / scene, "-o", tmp_path / f"{name}.fgs", *words) == 0
    assert (tmp_path / "plain.fgs").read_bytes() == (tmp_path / "turned.fgs").read_bytes()
    assert Scene.open(tmp_path / "flat.fgs").sh_degree == 0
    given = record(tmp_path / "flat.json")["input"]
    assert given["sh_degree"] == 0 and given["notes"][0].startswith("SH above degree 0 left out")  # type: ignore[index]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--frame", "XYZ"), "frame 'XYZ': expected three letters"),
        (("--lod", "0"), "--lod is for streamed scenes"),
        (("--lod", "-1"), "--lod -1: expected 0"),
        (("--sh-degree", "5"), "--sh-degree 5: expected 0 to 4"),
    ],
)
def test_words_that_mean_nothing(
    project: Path, tmp_path: Path, words: tuple[str, str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    scene, out = project / "point_cloud.ply", tmp_path / "out"
    for arguments in (
        ("compress", scene, "-o", f"{out}.fgs", *COMPRESS),
        ("decompress", scene, "-o", f"{out}.ply"),
        ("render", scene, "-o", out),
        ("evaluate", scene, "--against", scene),
    ):
        assert run(*arguments, *words) == 2
        assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_scene_opened_from_python(project: Path) -> None:
    plain, turned = Scene.open(project / "point_cloud.ply"), Scene.open(project / "rub.ply", frame="RUB", sh_degree=0)
    np.testing.assert_array_equal(turned.arrays()["means"], plain.arrays()["means"])
    assert (turned.sh_degree, plain.sh_degree) == (0, 1)
    with pytest.raises(InputError, match="--lod is for streamed scenes"):
        Scene.open(project / "rub.ply", lod=2)


@pytest.mark.parametrize("command", ["info", "verify", "trim", "decompress", "compress"])
def test_files_that_are_no_scene(tmp_path: Path, command: str, capsys: pytest.CaptureFixture[str]) -> None:
    os.mkfifo(tmp_path / "pipe.fgs")
    (tmp_path / "empty.fgs").touch()
    (tmp_path / "page.fgs").write_text("<!doctype html>")
    (tmp_path / "lfs.fgs").write_text("version https://git-lfs.github.com/spec/v1\nsize 77\n")
    (tmp_path / "link.fgs").symlink_to("nowhere")
    more = {
        "trim": ("-o", tmp_path / "o.fgs", "--max-size", "1MB"),
        "decompress": ("-o", tmp_path / "o.ply"),
        "compress": ("-o", tmp_path / "o.fgs"),
    }.get(command, ())
    for name, words in (
        ("pipe.fgs", "expected a file, found a pipe"),
        ("empty.fgs", "this is an empty file: is the download or the copy complete?"),
        ("page.fgs", "this is an HTML page: the download went wrong"),
        ("lfs.fgs", "this is a Git LFS pointer of 77 bytes, not the file itself: run `git lfs pull`"),
        ("link.fgs", "a link to nowhere, which does not exist"),
        ("none.fgs", "no such file or folder"),
    ):
        assert run(command, tmp_path / name, *more) == 2
        assert f"{tmp_path / name}: {words}" in capsys.readouterr().err
    assert not (tmp_path / "o.fgs").exists() and not (tmp_path / "o.ply").exists()


@pytest.mark.parametrize("words", [("verify",), ("trim", "--max-size", "1MB", "-o", "o.fgs")])
def test_commands_for_fgs_files_alone(wild: Path, words: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("lfs-pointer.ply", "brush-init.ply", "st-minimal-v2.spz", "playbot5.sog"):
        assert run(words[0], wild / name, *words[1:]) == 2
        assert ".fgs file: " in capsys.readouterr().err


def test_info_of_a_ply(project: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    marked = (project / "rub.ply").read_bytes().replace(b"ply\n", b"ply\ncomment SplatRenderMode: mip\n", 1)
    (tmp_path / "a.spz").write_bytes(marked + b"tail")
    assert run("info", tmp_path / "a.spz", "--json", tmp_path / "a.json") == 0
    told = record(tmp_path / "a.json")
    assert (told["format"], told["size"]) == ("ply", len(marked) + 4)
    assert (told["frame"], told["format_version"], told["antialiased"]) == ("RDF", None, True)
    assert told["notes"] == ["4 bytes behind the data ignored", "read as a PLY, as its first bytes say"]
    text = capsys.readouterr().out
    for line in ("axes:        RDF\n", "antialiased: yes\n", "note:        4 bytes behind the data ignored\n"):
        assert line in text


def views(*cameras: object) -> ViewSet:
    return ViewSet(list(cameras), None, [0], [], "cameras.json", None)  # type: ignore[arg-type]


def test_a_scene_behind_its_cameras(project: Path) -> None:
    """One that looks along z sees the scene, whose middle is (0, 0, 4); turned by mistake, all of it lies behind."""
    ahead, back = make_camera(), make_camera(rotation=np.diag([1.0, -1.0, -1.0]))
    wrong = replace(load_scene(project / "rub.ply"), frame=RUB)
    (words,) = frame_warnings(views(ahead), wrong)
    assert words.startswith("100 % of the Gaussians lie behind all 1 cameras of cameras.json")
    assert "read as RUB" in words and "--frame RDF" in words
    assert frame_warnings(views(ahead, back), wrong) == ()
    assert "lie behind" not in " ".join(
        frame_warnings(views(ahead), replace(wrong, frame=load_scene(project / "rub.ply").frame))
    )
    assert frame_warnings(replace(views(ahead), cameras_from="auto"), wrong) == ()
    right = load_scene(project / "point_cloud.ply")
    assert frame_warnings(views(ahead), replace(right, frame=RUB)) == ()


def test_the_doubt_is_told(project: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copy(project / "point_cloud.ply", tmp_path / "a.ply")
    # Turned, the scene has z from -6 to -2: these cameras see a quarter of it.
    cameras = [make_camera(translation=(0.0, 0.0, 3.2), name=f"c{i}") for i in range(2)]
    (tmp_path / "cameras.json").write_text(inria_json(cameras))
    words = ("--frame", "RUB", "--json", tmp_path / "a.json", *COMPRESS)
    assert run("compress", tmp_path / "a.ply", "-o", tmp_path / "a.fgs", *words) == 0
    out, err = capsys.readouterr()
    (told,) = [words for words in record(tmp_path / "a.json")["warnings"] if "behind all" in words]  # type: ignore[attr-defined]
    assert told in err and f"warning:     {told}" in out
