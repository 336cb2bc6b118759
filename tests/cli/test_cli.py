"""The command line as its users meet it: words, exit codes, streams, files."""

from __future__ import annotations

import errno
import importlib
import json
import os
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import click
import pytest

from flexgs_edge import cli
from flexgs_edge.cli import app
from flexgs_edge.errors import BudgetError, DeviceError, InputError, TargetError
from flexgs_edge.goals.steps import REFINE_STEPS
from flexgs_edge.methods.best.effort import EFFORTS
from flexgs_edge.run.options import EFFORT_WORDS, METHODS, SCORES, SELECTS, CompressOptions, ViewOptions
from interruptible import running
from tiny_project import COUNT, make_project

COMMANDS = list(app.COMMANDS)
PAPER = ["--method", "paper", "--effort", "fast", "--holdout", "4"]


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_project(tmp_path_factory.mktemp("tiny") / "scene")


@pytest.fixture(scope="module")
def packed(project: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("packed") / "a.fgs"
    with pytest.raises(SystemExit) as left:
        app.main(["compress", str(project / "point_cloud.ply"), "-o", str(path), "--max-drop", "2", "-q", *PAPER])
    assert left.value.code == 0
    return path


def run(*arguments: object, capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a command, in this process."""
    with pytest.raises(SystemExit) as left:
        app.main([str(argument) for argument in arguments])
    out = capsys.readouterr()
    code = left.value.code
    assert isinstance(code, int)
    return code, out.out, out.err


def spawn(*arguments: object, **kwargs: object) -> subprocess.CompletedProcess[str]:
    """The program in a process of its own."""
    command = [sys.executable, "-m", "flexgs_edge", *map(str, arguments)]
    root = Path(cli.__file__).parents[2]
    env = {**os.environ, "PYTHONPATH": str(root)}
    return subprocess.run(command, capture_output=True, text=True, env=env, timeout=120, check=False, **kwargs)  # type: ignore[call-overload]


def subcommand(name: str) -> click.Command:
    """A subcommand of `flexgs-edge`."""
    group = importlib.import_module("flexgs_edge.cli.app").command
    found = group.get_command(click.Context(group), name)
    assert isinstance(found, click.Command)
    return found


def test_version_and_help() -> None:
    version = spawn("--version")
    assert version.returncode == 0 and version.stdout == "flexgs-edge 0.1.0\n"
    overview = spawn("--help")
    assert overview.returncode == 0 and overview.stderr == ""
    assert all(name in overview.stdout for name in COMMANDS) and "Exit codes" in overview.stdout


@pytest.mark.parametrize("name", COMMANDS)
def test_help_of_every_command_teaches(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, text, _ = run(name, "--help", capsys=capsys)
    assert code == 0 and "Examples:" in text and f"flexgs-edge {name}" in text
    command = subcommand(name)
    options = [parameter for parameter in command.params if isinstance(parameter, click.Option)]
    assert all(option.help and option.help.endswith(".") for option in options), [o.name for o in options]
    assert "Show this message and exit." in text


def test_words_of_the_options_are_those_of_the_library() -> None:
    command = subcommand("compress")
    given = {parameter.name: parameter for parameter in command.params}
    fields = set(CompressOptions.__dataclass_fields__)
    assert fields <= set(given), fields - set(given)
    assert tuple(given["effort"].type.choices) == EFFORT_WORDS
    assert EFFORT_WORDS == tuple(EFFORTS) == tuple(REFINE_STEPS)
    assert tuple(given["method"].type.choices) == METHODS and tuple(given["select"].type.choices) == SELECTS
    assert tuple(given["score"].type.choices) == SCORES
    defaults = CompressOptions()
    for name in fields:
        default = given[name].default
        plain = None if default in (None, False) or "UNSET" in str(default).upper() else default
        assert plain == (getattr(defaults, name) or None), name
    for name in ("render", "evaluate"):
        found = {p.name for p in subcommand(name).params}
        assert set(ViewOptions.__dataclass_fields__) - found <= {"images", "holdout", "exposure"}


def test_the_examples_of_help_and_readme_make_sense() -> None:
    """Every `compress` that is shown may be typed: its options are known, and belong to its method."""
    root = Path(cli.__file__).parents[2]
    shown = [root / "README.md", *(root / "docs").glob("*.md"), *(root / "flexgs_edge" / "cli").glob("*.py")]
    lines = [line.strip() for path in shown for line in path.read_text().splitlines()]
    examples = [shlex.split(line, comments=True)[2:] for line in lines if line.startswith("flexgs-edge compress ")]
    command = subcommand("compress")
    assert len(examples) > 15
    for example in examples:
        with command.make_context("compress", list(example)) as context:
            given = {name: context.params[name] for name in CompressOptions.__dataclass_fields__}
            CompressOptions(**given)


def test_a_whole_way_in_processes_of_its_own(project: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.fgs"
    made = spawn(
        "compress", project / "point_cloud.ply", "-o", out, "--max-drop", 2, *PAPER, "--json", tmp_path / "a.json"
    )
    assert made.returncode == 0, made.stderr
    assert "decided by" in made.stdout and "flexgs-edge: searching for drop <= 2 dB" in made.stderr
    record = json.loads((tmp_path / "a.json").read_text())
    assert record["size"] == out.stat().st_size and record["reached"] is True
    steps = [
        ("info", out),
        ("verify", out),
        ("decompress", out, "-o", tmp_path / "a.ply"),
        (
            "render",
            out,
            "-o",
            tmp_path / "views",
            "--cameras",
            project / "cameras.json",
            "--views",
            "0:9:4",
            "--device",
            "numpy",
        ),
    ]
    (project / "point_cloud" / "iteration_7").mkdir(parents=True, exist_ok=True)
    (project / "point_cloud" / "iteration_7" / "point_cloud.ply").write_bytes(
        (project / "point_cloud.ply").read_bytes()
    )
    for step in steps:
        result = spawn(*step, "-q")
        assert result.returncode == 0, result.stderr
        assert result.stdout and result.stderr == "", (step, result.stderr)
    assert sorted(path.name for path in (tmp_path / "views").iterdir()) == ["v00.png", "v04.png", "v08.png"]
    judged = spawn(
        "evaluate",
        tmp_path / "a.ply",
        "--against",
        project / "point_cloud.ply",
        "--holdout",
        4,
        "--device",
        "numpy",
        "-q",
    )
    assert judged.returncode == 0 and "worst view" in judged.stdout


def test_json_on_stdout_moves_the_summary(packed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = run("info", packed, "--json", "-", capsys=capsys)
    assert code == 0 and json.loads(out)["command"] == "info" and "settings:" in err
    code, out, err = run("verify", packed, "--json", "-", "-q", capsys=capsys)
    assert code == 0 and json.loads(out)["ok"] is True and "every checksum holds" in err


def test_text_and_json_of_info_agree(packed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, text, _ = run("info", packed, capsys=capsys)
    _, out, _ = run("info", packed, "--json", "-", capsys=capsys)
    found = json.loads(out)
    assert str(found["count"]) in text and f"{found['size']} bytes" in text
    assert all(name in text for name in found["channels"])


def test_nothing_is_overwritten_without_force(
    project: Path, packed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("a.fgs", "a.ply", "a.json", "v00.png"):
        (tmp_path / name).write_text("precious")
    scene, poses = project / "point_cloud.ply", project / "cameras.json"
    cases = [
        ("compress", scene, "-o", tmp_path / "a.fgs", *PAPER),
        ("compress", scene, "-o", tmp_path / "n.fgs", "--json", tmp_path / "a.json", *PAPER),
        ("decompress", packed, "-o", tmp_path / "a.ply"),
        ("render", packed, "-o", tmp_path, "--cameras", poses, "--views", "0"),
        ("info", packed, "--json", tmp_path / "a.json"),
        ("devices", "--json", tmp_path / "a.json"),
    ]
    for case in cases:
        code, out, err = run(*case, capsys=capsys)
        assert code == 2 and out == "" and "exists" in err and "-f" in err, case
    assert all((tmp_path / name).read_text() == "precious" for name in ("a.fgs", "a.ply", "a.json", "v00.png"))
    code, _, _ = run("decompress", packed, "-o", tmp_path / "a.ply", "-f", capsys=capsys)
    assert code == 0 and (tmp_path / "a.ply").stat().st_size > 1000


@pytest.mark.parametrize(
    ("arguments", "words_of_it"),
    [
        (["nonsense"], "No such command"),
        (["compress"], "Missing argument"),
        (["compress", "none.ply", "-o", "a.fgs"], "none.ply: no such file or folder"),
        (["compress", "none.ply", "-o", "a.fgs", "--max-drop", "x"], "not a valid float"),
        (["compress", "none.ply", "-o", "a.fgs", "--max-drop", "1", "--min-ratio", "3"], "give one target"),
        (["compress", "none.ply", "-o", "a.fgs", "--max-size", "3QB"], "3QB"),
        (["compress", "none.ply", "-o", "a.fgs", "--background", "#12"], "#rrggbb"),
        (["compress", "none.ply", "-o", "a.fgs", "--up", "north"], "expected x, -x, y, -y, z, -z, or three numbers"),
        (["compress", "none.ply", "-o", "a.fgs", "--effort", "lots"], "lots"),
        (["compress", "none.ply"], "-o OUT.fgs is missing"),
        (["compress", "none.ply", "-o", "a.fgs", "--score-cache", "s.npz"], "add --method paper"),
        (["compress", "none.ply", "-o", "a.fgs", "--score", "gs"], "add --method paper"),
        (["compress", "none.ply", "-o", "a.fgs", "--method", "paper", "--refit"], "add --method best"),
        (["decompress", "none.fgs", "-o", "a.ply"], "none.fgs"),
        (["decompress", "none.fgs"], "Missing option"),
        (["info", "none.fgs"], "none.fgs"),
        (["verify", "none.fgs"], "none.fgs"),
        (["render", "none.ply", "-o", "d", "--views", "3-4"], "START:STOP:STEP"),
        (["evaluate", "none.ply"], "Missing option"),
        (["compress", "none.ply", "-o", "s.fgs", "--score", "magic"], "magic"),
    ],
)
def test_misuse_ends_with_2_and_no_traceback(
    arguments: list[str],
    words_of_it: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = run(*arguments, capsys=capsys)
    assert code == 2 and out == "" and words_of_it in err and "Traceback" not in err
    assert list(tmp_path.iterdir()) == []


def test_a_target_that_cannot_be_met_ends_with_3(
    project: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["compress", project / "point_cloud.ply", "-o", tmp_path / "a.fgs", "--max-drop", "0.0001", *PAPER]
    code, out, err = run(*command, capsys=capsys)
    assert code == 3 and out == "" and "closest point is drop" in err and list(tmp_path.iterdir()) == []
    code, out, _ = run(*command, "--best-effort", capsys=capsys)
    assert code == 0 and "NOT reached" in out and (tmp_path / "a.fgs").is_file()


def test_an_unknown_device_ends_with_4(project: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = run(
        "compress", project / "point_cloud.ply", "-o", tmp_path / "a.fgs", "--device", "no such thing", capsys=capsys
    )
    assert code == 4 and "no such thing" in err and list(tmp_path.iterdir()) == []


def test_too_little_memory_ends_with_5(project: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = run(
        "compress",
        project / "point_cloud.ply",
        "-o",
        tmp_path / "a.fgs",
        *PAPER,
        "--memory-limit",
        "1MiB",
        capsys=capsys,
    )
    assert code == 5 and "--memory-limit" in err and list(tmp_path.iterdir()) == []


def test_a_damaged_file_ends_with_2_and_names_the_part(
    packed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = bytearray(packed.read_bytes())
    data[-200] ^= 4
    (tmp_path / "b.fgs").write_bytes(data)
    code, out, err = run("verify", tmp_path / "b.fgs", capsys=capsys)
    assert code == 2 and "DAMAGED" in out and "damaged: chunk 0" in err
    code, _, err = run("decompress", tmp_path / "b.fgs", "-o", tmp_path / "b.ply", capsys=capsys)
    assert code == 2 and "checksum" in err and not (tmp_path / "b.ply").exists()
    (tmp_path / "c.fgs").write_bytes(data[:100])
    assert run("info", tmp_path / "c.fgs", capsys=capsys)[0] == 2


@pytest.mark.parametrize(
    ("error", "code", "says"),
    [
        (InputError("bad"), 2, "error: bad"),
        (TargetError("far"), 3, "error: far"),
        (DeviceError("none"), 4, "error: none"),
        (BudgetError("small"), 5, "error: small"),
        (MemoryError(), 5, "out of memory"),
        (OSError(errno.ENOSPC, "No space left on device"), 5, "disk is full"),
        (PermissionError(errno.EACCES, "Permission denied", "/x"), 2, "/x: Permission denied"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (ZeroDivisionError("oops"), 1, "internal error: ZeroDivisionError: oops"),
    ],
)
@pytest.mark.parametrize("debug", [False, True])
def test_one_door_out(
    error: BaseException,
    code: int,
    says: str,
    debug: bool,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fail(*args: object) -> None:
        raise error

    monkeypatch.setattr("flexgs_edge.commands.info.info", fail)
    found, out, err = run("info", "x.fgs", *(["--debug"] if debug else []), capsys=capsys)
    assert found == code and out == "" and says in err
    assert ("Traceback" in err) == debug


def test_ctrl_c_leaves_nothing_behind(sample_dir: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "flexgs_edge", "compress", str(sample_dir / "point_cloud.ply"), "-o", "a.fgs"]
    root = str(Path(cli.__file__).parents[2])
    # Ten poses on the twins: scoring starts soon and lasts for seconds, so that the interrupt comes in its middle.
    poses = tmp_path / "poses.json"
    poses.write_text(json.dumps(json.loads((sample_dir / "cameras.json").read_text())[:10]))
    words = ["--cameras", "poses.json", "--images", "none", "--method", "paper", "--device", "numpy"]
    with running(*command, *words, cwd=tmp_path, env={**os.environ, "PYTHONPATH": root}) as process:
        assert process.stderr is not None
        for line in process.stderr:
            if "scoring" in line:
                break
        time.sleep(0.2)
        process.send_signal(signal.SIGINT)
        rest = process.stderr.read()
        assert process.wait(60) == 130
    assert "interrupted" in rest and "Traceback" not in rest and list(tmp_path.iterdir()) == [poses]


def test_a_signal_that_comes_twice_breaks_no_cleaning_up(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """`timeout` sends SIGTERM to the program and to its group."""
    before = signal.getsignal(signal.SIGTERM)
    try:
        assert run("devices", capsys=capsys)[0] in (0, 4)
        with pytest.raises(SystemExit) as ended:
            signal.raise_signal(signal.SIGTERM)
        assert ended.value.code == 128 + signal.SIGTERM
        signal.raise_signal(signal.SIGTERM)
        monkeypatch.setattr(app, "REPEAT_SECONDS", 0.0)
        with pytest.raises(SystemExit):
            signal.raise_signal(signal.SIGTERM)
    finally:
        signal.signal(signal.SIGTERM, before)


def test_devices_lists_and_explains(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = run("devices", "--json", "-", capsys=capsys)
    record = json.loads(out)
    assert set(record) == {"devices", "chosen", "reason"} and record["reason"]
    assert code == (4 if record["chosen"] is None else 0)
    for device in record["devices"]:
        assert {"index", "name", "platform", "type", "self_test", "global_bytes", "max_alloc_bytes"} <= set(device)
        assert f"[{device['index']}] {device['name']}" in err
    code, out, err = run("devices", "--device", "no such thing", capsys=capsys)
    assert code == 4 and "chosen" not in out and "no" in err


def test_no_device_is_exit_code_4(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The loader looks for runtimes in an empty folder, in a process of its own."""
    monkeypatch.setenv("OCL_ICD_VENDORS", str(tmp_path))
    monkeypatch.delenv("OCL_ICD_FILENAMES", raising=False)
    done = spawn("devices", "--json", "-")
    assert done.returncode == 4, done.stderr
    found = json.loads(done.stdout)
    assert found == {"devices": [], "chosen": None, "reason": found["reason"]}
    assert "pocl-opencl-icd" in done.stderr


def test_without_photos_and_quiet(project: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = project / "point_cloud.ply"
    code, out, err = run(
        "compress",
        scene,
        "--dry-run",
        "--images",
        "none",
        "--prune-rate",
        0.2,
        "--sh-rate",
        0.3,
        "-q",
        *PAPER,
        capsys=capsys,
    )
    assert code == 0 and err == "" and f"{COUNT - COUNT // 5} of {COUNT} Gaussians" in out and "no photos" in out
