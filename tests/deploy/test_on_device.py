"""`deploy/on-device.sh` on this machine: set-up without rights, limits, scores kept between calls, and what it refuses."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import zlib
from pathlib import Path

import numpy as np
import pytest

from flexgs_edge.io.ply import PlySource, write_ply
from flexgs_edge.units import parse_size
from tiny_project import make_project

VIEWS = 9
FAST = ("--method", "paper", "--resolution", "120", "--prune-rate", "0.3", "--sh-rate", "0.4")


@pytest.fixture(scope="module")
def machine(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """An environment where everything is installed, and where apt-get, sudo and pip install would be noticed."""
    folder = tmp_path_factory.mktemp("machine")
    venv = folder / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(venv)], check=True)
    (site,) = venv.glob("lib/python*/site-packages")
    (site / "here.pth").write_text(f"{repository}\n{sysconfig.get_paths()['purelib']}\n")
    # The mark that setup.sh leaves after an installation: `cksum` of these files, and the checkout.
    names = ("setup.cfg", "pyproject.toml", "constraints.txt", "flexgs_edge/_version.py")
    data = b"".join((repository / name).read_bytes() for name in names)
    mark = subprocess.run(["cksum"], input=data, capture_output=True, check=True).stdout.decode().strip()
    (venv / "flexgs-edge.base").write_text(f"{mark} {repository}\n")
    tools = folder / "tools"
    tools.mkdir()
    for tool in ("apt-get", "sudo"):
        (tools / tool).write_text(f"#!/bin/sh\necho {tool} >>{folder}/asked\nexit 1\n")
        (tools / tool).chmod(0o755)
    variables = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "FLEXGS_MEMORY_SHARE")}
    return {**variables, "FLEXGS_VENV": str(venv), "PATH": f"{tools}:{os.environ['PATH']}", "ASKED": f"{folder}/asked"}


def call(
    repository: Path, machine: dict[str, str], folder: Path, *arguments: str, **variables: str
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(repository / "deploy" / "on-device.sh"), *arguments],
        cwd=folder,
        env={**machine, **variables},
        capture_output=True,
        text=True,
        check=False,
        timeout=240,
    )


@pytest.fixture
def scene(sample_dir: Path, tmp_path: Path) -> Path:
    """The sample with a few of its views."""
    folder = tmp_path / "my scene"
    (folder / "images").mkdir(parents=True)
    shutil.copyfile(sample_dir / "point_cloud.ply", folder / "point_cloud.ply")
    cameras = sorted(json.loads((sample_dir / "cameras.json").read_text()), key=lambda camera: camera["img_name"])
    chosen = cameras[:: len(cameras) // VIEWS][:VIEWS]
    (folder / "cameras.json").write_text(json.dumps(chosen))
    for camera in chosen:
        name = Path(camera["img_name"]).stem + ".jpg"
        shutil.copyfile(sample_dir / "images" / name, folder / "images" / name)
    return folder / "point_cloud.ply"


def test_scores_are_kept_and_made_anew_for_another_scene(
    repository: Path, machine: dict[str, str], scene: Path
) -> None:
    folder, output, kept = scene.parent, scene.with_suffix(".fgs"), scene.with_name("point_cloud.scores.npz")
    first = call(repository, machine, folder, "point_cloud.ply", *FAST, "--json", "first.json")
    assert first.returncode == 0, first.stderr
    assert "scores: made in this run" in first.stderr and "made anew, kept in point_cloud.scores.npz" in first.stdout
    assert "self-test: ok" in first.stderr and "chosen: [" in first.stderr and "board: " in first.stderr
    record = json.loads((folder / "first.json").read_text())
    assert record["run"]["memory_limit"] == parse_size(first.stderr.split("memory limit: ")[1].split(",")[0])
    assert ", 60 % of the " in first.stderr
    data, scores = output.read_bytes(), zlib.crc32(kept.read_bytes())

    # Nothing is overwritten unless told to.
    refused = call(repository, machine, folder, "point_cloud.ply", *FAST)
    assert refused.returncode == 2 and "-f to overwrite" in refused.stderr and output.read_bytes() == data

    again = call(repository, machine, folder, "point_cloud.ply", "-qf", *FAST, "--json", "-")
    assert again.returncode == 0, again.stderr
    record = json.loads(again.stdout)  # and nothing else on stdout
    assert record["scores_reused"] and "score" not in record["run"]["stages"]
    assert "scores: from point_cloud.scores.npz, if" in again.stderr and "reused from" in again.stderr
    assert output.read_bytes() == data and zlib.crc32(kept.read_bytes()) == scores

    source = PlySource(scene)
    write_ply(folder / "fewer.ply", source.select(np.arange(20_000)))
    os.replace(folder / "fewer.ply", scene)
    changed = call(repository, machine, folder, "point_cloud.ply", "-qf", *FAST)
    assert changed.returncode == 0, changed.stderr
    assert "made anew, kept in" in changed.stdout and zlib.crc32(kept.read_bytes()) != scores
    assert np.load(kept)["scores"].shape == (20_000,)
    assert not Path(machine["ASKED"]).exists(), "apt-get or sudo was called although everything is installed"


def test_what_is_given_is_not_added(repository: Path, machine: dict[str, str], tmp_path: Path) -> None:
    make_project(tmp_path / "scene", photos=False)
    (tmp_path / "out").mkdir()
    given = (
        "-qfoout/b.fgs",
        "--memory-limit=1GiB",
        "--score-cache",
        "out/c.npz",
        "--device",
        "numpy",
        "--holdout",
        "4",
    )
    done = call(
        repository, machine, tmp_path, "scene/point_cloud.ply", *given, *FAST, OCL_ICD_VENDORS=str(tmp_path / "no")
    )
    assert done.returncode == 0, done.stderr
    assert "memory limit: 1GiB, as given" in done.stderr and "NumPy twins, as asked for" in done.stderr
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["b.fgs", "c.npz"]
    assert not list((tmp_path / "scene").glob("*.fgs")) and not list((tmp_path / "scene").glob("*.npz"))
    # The same machine without numpy asked for: an error that says what to do, no silent fallback.
    refused = call(repository, machine, tmp_path, "scene/point_cloud.ply", OCL_ICD_VENDORS=str(tmp_path / "no"))
    assert refused.returncode == 4 and "no OpenCL device passes the self-test" in refused.stderr
    assert "docs/jetson.md" in refused.stderr and "--device numpy" in refused.stderr
    assert not list((tmp_path / "scene").glob("*.fgs"))
    # Without a method: the default one, which has no scores to keep, so what only the other knows is refused.
    other = ("--device", "numpy", "--score-cache", "c.npz")
    refused = call(repository, machine, tmp_path, "scene/point_cloud.ply", *other, OCL_ICD_VENDORS=str(tmp_path / "no"))
    assert refused.returncode == 2 and "add --method paper" in refused.stderr
    assert "scores: --method best measures as it goes" in refused.stderr and not list(tmp_path.glob("*.npz"))
    Path(machine["ASKED"]).unlink(missing_ok=True)  # it may ask for PoCL then, and is told no


@pytest.mark.parametrize(
    ("arguments", "variables", "code", "words"),
    [
        (["--help"], {}, 0, "Usage: deploy/on-device.sh SCENE"),
        (["a.ply", "-f", "-h"], {}, 0, "Usage: deploy/on-device.sh SCENE"),
        ([], {}, 2, "Usage: deploy/on-device.sh SCENE"),
        (["-o", "a.fgs"], {}, 2, "Usage: deploy/on-device.sh SCENE"),
        (["missing.ply"], {}, 1, "missing.ply: no such scene"),
        (["here.fgs"], {}, 1, "here.fgs: give the file to write with -o, since this one is the input"),
        (
            ["here.fgs"],
            {"FLEXGS_MEMORY_SHARE": "110"},
            1,
            "FLEXGS_MEMORY_SHARE=110: expected a percentage from 1 to 99",
        ),
    ],
)
def test_help_and_misuse_need_no_set_up(
    repository: Path, machine: dict[str, str], tmp_path: Path, arguments: list[str], variables: dict[str, str], code: int,
    words: str,
) -> None:  # fmt: skip
    (tmp_path / "here.fgs").touch()
    done = call(repository, {**machine, "FLEXGS_VENV": "/nonexistent"}, tmp_path, *arguments, **variables)
    assert done.returncode == code and words in (done.stdout if code == 0 else done.stderr)
