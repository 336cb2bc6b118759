"""Several scenes on the command line: exit codes, streams, JSON, Ctrl-C; and a single scene as ever."""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from pathlib import Path

import pytest

from flexgs_edge import cli
from flexgs_edge.cli import app
from flexgs_edge.io.ply import write_ply
from interruptible import running
from synthetic import random_scene

BLIND = ["--method", "paper", "--cameras", "none", "--prune-rate", "0", "--sh-rate", "0"]


@pytest.fixture
def scans(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two scenes, and one cut short; the test runs beside their folder."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "scans"
    folder.mkdir()
    for seed, name in enumerate("abc"):
        write_ply(folder / f"{name}.ply", random_scene(60 + seed, seed=seed))
    (folder / "b.ply").write_bytes((folder / "b.ply").read_bytes()[:-9])
    return folder


def run(*arguments: object, capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of `compress`, in this process."""
    with pytest.raises(SystemExit) as left:
        app.main(["compress", *map(str, arguments), *BLIND])
    out = capsys.readouterr()
    code = left.value.code
    assert isinstance(code, int)
    return code, out.out, out.err


def test_a_folder_with_a_bad_scene(scans: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (scans / "notes.txt").touch()
    code, out, err = run("scans", "-o", "out/", "--json", "all.json", capsys=capsys)
    assert code == 2 and sorted(os.listdir("out")) == ["a.fgs", "c.fgs"]
    assert out.splitlines()[-1].startswith("2 of 3 scenes done, 1 failed: ") and "FAILED: truncated" in out
    for words in ("scans: skipped notes.txt", "scene 2 of 3: scans/b.ply", "scans/b.ply: error: truncated"):
        assert f"flexgs-edge: {words}" in err
    assert err.count("skipped") == 1 and "Traceback" not in err
    records = json.loads(Path("all.json").read_text())
    assert [record["input"]["path"] for record in records] == ["scans/a.ply", "scans/b.ply", "scans/c.ply"]
    assert [record.get("output") for record in records] == ["out/a.fgs", None, "out/c.fgs"]
    assert records[1]["exit_code"] == 2 and "truncated" in records[1]["error"]


def test_all_well(scans: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = run("scans/a.ply", "scans/c.ply", "-o", "out", "-q", "--json", "-", capsys=capsys)
    assert code == 0 and [record["count"] for record in json.loads(out)] == [60, 62]
    assert "2 of 2 scenes done: " in err and "scene 1 of 2" not in err
    code, _, err = run("scans/a.ply", "scans/c.ply", "-o", "out", "-q", capsys=capsys)
    assert code == 2 and err.count("the file exists") == 2
    assert run("scans/a.ply", "scans/c.ply", "-o", "out", "-f", capsys=capsys)[0] == 0


def test_a_dry_run_needs_no_output(scans: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run("scans", "--dry-run", capsys=capsys)
    assert code == 2 and "nothing was written" in out and os.listdir() == ["scans"]


def test_debug_shows_the_traceback_of_a_scene(scans: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "Traceback" in run("scans", "-o", "out", "--debug", capsys=capsys)[2]
    assert "Traceback" not in run("scans", "-o", "out", capsys=capsys)[2]


def test_a_single_scene_is_as_ever(scans: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run("scans/a.ply", "-o", "a.fgs", "--json", "a.json", capsys=capsys)
    assert code == 0 and out.startswith("scene:       scans/a.ply: 60 Gaussians")
    assert json.loads(Path("a.json").read_text())["output"] == "a.fgs"
    assert run("scans/b.ply", "-o", "b.fgs", capsys=capsys)[0] == 2
    code, out, _ = run("scans/a.ply", "-o", "one/", "--json", "-", capsys=capsys)
    assert code == 0 and [record["output"] for record in json.loads(out)] == ["one/a.fgs"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["scans", "-o", "all.fgs"], "all.fgs/ to mean a folder"),
        (["scans"], "-o OUT/ is missing"),
        (["scans/a.ply", "scans/c.ply", "-o", "out", "--report", "page"], "--report page belongs to one scene"),
        (["scans/a.ply", "-o", "a.fgs", "--format", "spz"], "--format spz with -o a.fgs"),
        (["scans/a.ply", "-o", "a.fgs", "--format", "png"], "--format png: expected one of"),
        (["scans", "-o", "out", "--format", "png"], "--format png: expected one of"),
        (["empty", "-o", "a.fgs"], "is it a model folder?"),
    ],
)
def test_misuse(arguments: list[str], says: str, scans: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("empty").mkdir()
    code, out, err = run(*arguments, capsys=capsys)
    assert code == 2 and out == "" and says in err and sorted(os.listdir()) == ["empty", "scans"]


def test_ctrl_c_stops_all_and_tells_what_is_done(scans: Path, sample_dir: Path) -> None:
    # On the twins, drawing the second scene would take minutes: the interrupt surely comes in the middle.
    words = ["--method", "paper", "--device", "numpy", "--resolution", "24", "--prune-rate", "0", "--sh-rate", "0"]
    inputs = ["scans/b.ply", "scans/a.ply", str(sample_dir / "point_cloud.ply"), "scans/c.ply"]
    command = [sys.executable, "-m", "flexgs_edge", "compress", *inputs, "-o", "out", *words]
    root = str(Path(cli.__file__).parents[2])
    with running(*command, env={**os.environ, "PYTHONPATH": root}) as process:
        assert process.stderr is not None and process.stdout is not None
        for line in process.stderr:
            if "scene 3 of 4" in line:
                break
        time.sleep(0.2)
        process.send_signal(signal.SIGINT)
        rest, told = process.stderr.read(), process.stdout.read()
        assert process.wait(60) == 130
    assert "interrupted" in rest and "Traceback" not in rest and os.listdir("out") == ["a.fgs"]
    assert "1 of 4 scenes done, 1 failed, 2 not begun or not finished: " in told
