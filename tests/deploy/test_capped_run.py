"""deploy/capped-run.sh: commands below and above a cap that the kernel keeps, signals, and what is said where there is none."""

from __future__ import annotations

import os
import re
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from interruptible import running

SCRIPT = Path(__file__).resolve().parents[2] / "deploy" / "capped-run.sh"
HOLD = """
import sys, time
held = b"x" * int(sys.argv[1])  # written to, so that every page is there
print("held", flush=True)
time.sleep(float(sys.argv[2]))
"""
SLEEP = """
import sys, time
try:
    print("ready", flush=True)
    time.sleep(60)
except KeyboardInterrupt:
    time.sleep(0.3)
    print("cleaned up", flush=True)
    sys.exit(130)
"""
MIB = 1 << 20
# Without what starts coverage in every Python: it would take the commands' memory.
ENVIRONMENT = {name: value for name, value in os.environ.items() if not name.startswith("COV")}


def capped(limit: str, *command: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """One run of the script."""
    return subprocess.run(
        [str(SCRIPT), limit, *command],
        env={**ENVIRONMENT, **variables},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def group_of(said: str) -> Path:
    """The group that the script says it has made."""
    found = re.search(r"==> cap: [0-9]+ bytes .* (/\S+/flexgs-capped-[0-9]+)\n", said)
    assert found is not None, said
    return Path(found.group(1))


@pytest.fixture(scope="module")
def groups() -> None:
    """Skips where no control group can be made; the script says why."""
    done = capped("64MiB", "true")
    if done.returncode == 125 and "no memory control group" in done.stderr:
        pytest.skip(done.stderr)
    assert done.returncode == 0, done.stderr


def test_below_the_cap(groups: None) -> None:
    done = capped("96MiB", sys.executable, "-c", HOLD, str(24 * MIB), "0.5")
    assert (done.returncode, done.stdout) == (0, "held\n"), done.stderr
    assert "KILLED" not in done.stderr
    peak = re.search(r"==> peak: ([0-9]+) bytes .* of 100663296, file cache included", done.stderr)
    anonymous = re.search(r"==> peak of anonymous memory: ([0-9]+) bytes", done.stderr)
    assert peak is not None and anonymous is not None, done.stderr
    # Both count the interpreter as well; half a second is time for several samples.
    assert 24 * MIB < int(anonymous.group(1)) < 64 * MIB
    assert 24 * MIB < int(peak.group(1)) <= 96 * MIB
    assert not group_of(done.stderr).exists()


def test_above_the_cap(groups: None) -> None:
    done = capped("48MiB", sys.executable, "-c", HOLD, str(200 * MIB), "0")
    assert (done.returncode, done.stdout) == (137, "")
    assert "==> KILLED by the cap: the command needed more than 50331648 bytes (48.0 MiB)" in done.stderr
    assert "line " not in done.stderr, "bash's own words about the killed command"
    assert not group_of(done.stderr).exists()


def test_file_cache_alone_kills_nothing(groups: None, tmp_path: Path) -> None:
    """What reading and writing files leaves behind is counted, but dropped before anything is killed."""
    copy = "import sys; f = open(sys.argv[1], 'wb'); [f.write(bytes(1 << 20)) for _ in range(100)]"
    done = capped("48MiB", sys.executable, "-c", copy, str(tmp_path / "file"))
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "file").stat().st_size == 100 * MIB


def test_a_killed_child_is_told_apart(groups: None) -> None:
    child = f"import subprocess, sys; sys.exit(-subprocess.call([sys.executable, '-c', {HOLD!r}, '{200 * MIB}', '0']))"
    done = capped("48MiB", sys.executable, "-c", child)
    assert done.returncode == signal.SIGKILL
    assert "the cap killed 1 of the command's processes; the command itself ended with status 9" in done.stderr


def test_status_and_streams_are_the_commands(groups: None) -> None:
    echo = "import sys; print(sys.stdin.read() * 2); print('words', file=sys.stderr); sys.exit(7)"
    done = subprocess.run(
        [str(SCRIPT), "64MB", sys.executable, "-c", echo],
        input="in",
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout) == (7, "inin\n")
    assert "\nwords\n" in done.stderr
    assert capped("64MB", "no-such-command-here").returncode == 127


def test_what_is_left_running_is_killed(groups: None) -> None:
    done = capped("64MiB", "bash", "-c", "setsid sleep 600 </dev/null >/dev/null 2>&1 & exit 3")
    assert done.returncode == 3
    assert "==> 1 processes that the command had left running were killed" in done.stderr
    assert not group_of(done.stderr).exists()


@pytest.mark.parametrize(
    ("sent", "status", "last"), [(signal.SIGINT, 130, "cleaned up"), (signal.SIGTERM, 143, "ready")]
)
def test_signals_reach_the_command_and_the_group_goes(
    groups: None, sent: signal.Signals, status: int, last: str
) -> None:
    with running(str(SCRIPT), "64MiB", sys.executable, "-c", SLEEP, env=ENVIRONMENT) as process:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
        process.send_signal(sent)
        out, said = process.communicate(timeout=30)
    assert process.returncode == status, said
    assert ("ready\n" + out).split("\n")[-2] == last
    assert "KILLED" not in said
    assert not group_of(said).exists()


def test_ctrl_c_at_a_terminal_comes_once(groups: None) -> None:
    """The terminal sends it to the command itself; a second one would break into its clean-up."""
    pty = pytest.importorskip("pty")
    terminal, other_side = pty.openpty()
    streams = dict.fromkeys(("stdin", "stdout", "stderr"), other_side)
    said, sent = b"", False
    with (
        os.fdopen(terminal, "r+b", buffering=0) as ours,
        running(str(SCRIPT), "64MiB", sys.executable, "-c", SLEEP, env=ENVIRONMENT, **streams) as process,
    ):
        os.close(other_side)
        while select.select([ours], [], [], 30)[0]:
            try:
                said += os.read(terminal, 4096)
            except OSError:  # the other side has closed
                break
            if not sent and b"ready" in said:
                time.sleep(0.2)
                sent = os.write(terminal, b"\x03") == 1
        status = process.wait(30)
    assert status == 130, said
    assert b"cleaned up" in said
    assert not group_of(said.decode().replace("\r", "")).exists()


@pytest.mark.parametrize(
    ("limit", "size"),
    [("67108864", 67108864), ("64MiB", 67108864), ("0.5gb", 500000000), (".0625 GiB", 67108864), ("65536kB", 65536000)],
)
def test_limits_are_read_as_by_the_program(groups: None, limit: str, size: int) -> None:
    from flexgs_edge.units import parse_size

    assert parse_size(limit) == size
    done = capped(limit, "true")
    assert done.returncode == 0 and f"==> cap: {size} bytes" in done.stderr, done.stderr


@pytest.mark.parametrize(
    "limit", ["lots", "12 apples", "0", "0.0MiB", "1e9", "1.5.5MB", "99999999999999999999", "9000000000GB"]
)
def test_wrong_limits(limit: str) -> None:
    done = capped(limit, "true")
    assert (done.returncode, done.stdout) == (125, "")
    assert f"LIMIT '{limit}': expected a number above zero and a unit such as 700000000, 1.5GB" in done.stderr


def test_no_command() -> None:
    assert (done := capped("64MiB")).returncode == 125 and "no COMMAND after LIMIT" in done.stderr
    assert (done := capped("")).returncode == 125 and done.stderr.startswith("Usage: ")
    assert (done := capped("--help")).returncode == 0 and done.stdout.startswith("Usage: ")


def test_says_what_was_tried_where_there_are_no_groups(tmp_path: Path) -> None:
    tools = tmp_path / "bin"
    tools.mkdir()
    # A systemd-run that fails as the real one does without a session.
    (tools / "systemd-run").write_text("#!/bin/sh\necho 'Failed to connect to bus: No medium found' >&2\nexit 1\n")
    (tools / "systemd-run").chmod(0o755)
    empty = tmp_path / "empty"
    empty.mkdir()
    marker = tmp_path / "marker"
    words = {"FLEXGS_CGROUP_ROOT": str(empty), "PATH": f"{tools}:{os.environ['PATH']}"}
    done = capped("64MiB", "touch", str(marker), **words)
    assert (done.returncode, done.stdout) == (125, "")
    lines = done.stderr.splitlines()
    assert lines[0] == "error: no memory control group can be had here, so nothing was run"
    assert lines[1].strip() == f"cgroup v2: {empty} has no cgroup.controllers"
    assert lines[2].strip() == f"cgroup v1: {empty}/memory has no memory.limit_in_bytes"
    assert lines[3].strip() == "systemd-run --scope: Failed to connect to bus: No medium found"
    assert lines[4].strip().startswith("what to do: run it as root")
    assert not marker.exists()


def test_plain_folders_are_no_groups(tmp_path: Path) -> None:
    """Both versions' files are there, but what is made in them has no limit: nothing is run, nothing is left."""
    memory = tmp_path / "memory"
    memory.mkdir()
    (memory / "memory.limit_in_bytes").write_text("1\n")
    for name in ("cgroup.procs", "cgroup.subtree_control"):
        (tmp_path / name).write_text("")
    (tmp_path / "cgroup.controllers").write_text("cpu memory\n")
    done = capped("64MiB", "true", FLEXGS_CGROUP_ROOT=str(tmp_path))
    if done.returncode == 0 and "systemd-run" in done.stderr:
        pytest.skip("systemd gives scopes here, whatever the folder of groups holds")
    assert done.returncode == 125
    assert f"groups made in {tmp_path} have no memory.max: the memory controller is not handed down" in done.stderr
    assert f"groups made in {memory} have no memory.limit_in_bytes" in done.stderr
    assert sorted(path.name for path in tmp_path.rglob("*")) == [
        "cgroup.controllers",
        "cgroup.procs",
        "cgroup.subtree_control",
        "memory",
        "memory.limit_in_bytes",
    ]
