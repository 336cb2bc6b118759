"""Sizes as people write them, and the planner that keeps the memory limit."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexgs_edge.errors import BudgetError, InputError
from flexgs_edge.kernels.backend import TwinBackend
from flexgs_edge.memory.budget import ROOM, MemoryBudget
from flexgs_edge.memory.process import available_memory, current_rss, peak_rss
from flexgs_edge.units import format_mib, format_size, parse_size


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("700", 700),
        ("0", 0),
        ("700B", 700),
        ("1.5MB", 1_500_000),
        (" 1.5 mb ", 1_500_000),
        ("512MiB", 512 * 2**20),
        ("512mib", 512 * 2**20),
        ("2KiB", 2048),
        ("2kb", 2000),
        (".5GiB", 2**29),
        ("3GB", 3 * 10**9),
        ("1.0000001MB", 1_000_000),
    ],
)
def test_parse_size(text: str, size: int) -> None:
    assert parse_size(text) == size


@pytest.mark.parametrize(
    "text",
    ["", "MB", "-1MB", "1.5.2MB", "1e6", "12 XB", "1TB", "1,5MB", "0x10", "nan", "inf", "1.MB", "\uff15MB", "1MB 2"],
)
def test_parse_size_refuses(text: str) -> None:
    with pytest.raises(InputError, match=re.escape(repr(text))):
        parse_size(text)


@given(st.integers(0, 2**50))
def test_limits_read_back(size: int) -> None:
    """What an error names as the smallest limit is enough, and at most a MiB more."""
    assert size <= parse_size(format_mib(size)) < size + 2**20


@pytest.mark.parametrize(
    ("size", "text"),
    [(0, "0 B"), (999, "999 B"), (1000, "1.00 kB"), (1_500_000, "1.50 MB"), (3_510_000_000, "3.51 GB")],
)
def test_format_size(size: int, text: str) -> None:
    assert format_size(size) == text


@pytest.mark.parametrize(
    ("free", "per_row", "fixed", "minimum", "most", "rows"),
    [
        (1000, 10, 0, 1, 1 << 20, 100),
        (1000, 10, 995, 0, 1 << 20, 0),
        (1000, 10, 1, 1, 1 << 20, 99),
        (1000, 10, 990, 1, 1 << 20, 1),
        (1000, 10, 0, 1, 7, 7),
        (1000, 0, 0, 1, 64, 64),
        (1000, 10, 0, 100, 100, 100),
    ],
)
def test_rows(free: int, per_row: int, fixed: int, minimum: int, most: int, rows: int) -> None:
    assert MemoryBudget(5000, 5000 - free).rows("a stage", per_row, fixed, minimum, most) == rows


@given(st.integers(0, 10**6), st.integers(0, 10**4), st.integers(1, 1000), st.integers(0, 10**5), st.integers(1, 50))
def test_rows_always_fit(limit: int, used: int, per_row: int, fixed: int, minimum: int) -> None:
    """Either the rows fit, or the error names a limit at which the least of them do."""
    budget = MemoryBudget(limit, used)
    try:
        rows = budget.rows("a stage", per_row, fixed, minimum)
    except BudgetError as error:
        named = re.search(r"use --memory-limit (\S+) or more", str(error))
        assert named
        enough = MemoryBudget(parse_size(named.group(1)) - ROOM, used)
        assert enough.rows("a stage", per_row, fixed, minimum) >= minimum
        assert budget.free < fixed + minimum * per_row
    else:
        assert rows >= minimum and fixed + rows * per_row <= budget.free


def test_require_says_what_and_how_much() -> None:
    budget = MemoryBudget(300 * 2**20, 100 * 2**20)
    budget.require("scoring", 200 * 2**20)
    with pytest.raises(BudgetError) as caught:
        budget.require("scoring", 200 * 2**20 + 1)
    for words in (
        "scoring needs 201MiB",
        "100MiB already held",
        "limit is 300MiB",
        "use --memory-limit 309MiB or more",  # and 8 MiB for what varies
    ):
        assert words in str(caught.value)


def test_errors_name_what_is_foreseen() -> None:
    budget = MemoryBudget(300 * 2**20, 100 * 2**20)
    budget.foreseen = lambda: 400 * 2**20
    budget.require("scoring", 200 * 2**20)
    for size, words in (
        (201, "use --memory-limit 408MiB or more, which counts later stages too"),
        (300, "use --memory-limit 408MiB or more"),
        (301, "use --memory-limit 409MiB or more"),
    ):
        with pytest.raises(BudgetError) as caught:
            budget.require("scoring", size * 2**20)
        assert str(caught.value).endswith(words)


def test_what_is_held_already_is_found_by_the_next_stage() -> None:
    budget = MemoryBudget(300 * 2**20, 100 * 2**20)
    budget.hold(201 * 2**20)
    with pytest.raises(
        BudgetError, match=r"the program already holds 301MiB, .* 300MiB: use --memory-limit 309MiB or more$"
    ):
        budget.require("the program", 0)


def test_take_and_give() -> None:
    budget = MemoryBudget(1000)
    budget.take("a stage", 600)
    assert budget.free == 400
    with pytest.raises(BudgetError):
        budget.take("another", 401)
    assert budget.free == 400  # a refusal takes nothing
    budget.give(600)
    assert budget.free == 1000


def test_arrays_of_the_twins_are_counted() -> None:
    budget = MemoryBudget(1000)
    backend = TwinBackend(budget)
    array = backend.array((10, 5), float)
    assert budget.used == 400
    array.release()
    array.release()
    assert budget.used == 0
    with pytest.raises(BudgetError):
        backend.array((1001,), "u1")
    assert budget.used == 0


def test_default_limit() -> None:
    """Without a limit: three quarters of what the machine can still give."""
    budget = MemoryBudget.from_limit(None)
    # The kernel keeps the two counters apart and updates them in batches of pages.
    assert 0 < current_rss() <= peak_rss() + 2**22
    assert budget.used >= 2**20
    assert 0.5 * available_memory() <= budget.free <= available_memory()
    assert MemoryBudget.from_limit(10**9).limit == 10**9


MIB = 2**20


def machine(folder: Path, group: str, **limits: dict[str, tuple[object, int, int]]) -> tuple[Path, Path]:
    """A /proc with 1000 MiB free, and control groups: path -> (limit, used, files that can be given up), in MiB."""
    (folder / "proc" / "self").mkdir(parents=True)
    (folder / "proc" / "meminfo").write_text("MemTotal: 4096000 kB\nMemAvailable: 1024000 kB\n")
    (folder / "proc" / "self" / "cgroup").write_text(group)
    for version, places in limits.items():
        names = ("memory.max", "memory.current", "") if version == "v2" else V1
        for place, (most, used, files) in places.items():
            path = folder / "groups" / ("" if version == "v2" else "memory") / place
            path.mkdir(parents=True, exist_ok=True)
            (path / names[0]).write_text(f"{most * MIB if isinstance(most, int) else most}\n")
            (path / names[1]).write_text(f"{used * MIB}\n")
            (path / "memory.stat").write_text(f"anon 5\n{names[2]}inactive_file {files * MIB}\n")
    return folder / "proc", folder / "groups"


V1 = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_")


@pytest.mark.parametrize(
    ("group", "limits", "expected"),
    [
        ("0::/\n", {}, 1000),
        ("0::/a/b\n", {"v2": {"a": (700, 300, 100), "a/b": ("max", 200, 0)}}, 500),
        ("0::/a\n", {"v2": {"a": (5000, 300, 0)}}, 1000),
        # A container that sees its own group at the top, under the path that the host has for it.
        ("0::/docker/12ab\n", {"v2": {"": (400, 100, 0)}}, 300),
        ("0::/../x\n", {"v2": {"": (400, 100, 50)}}, 350),
        ("5:cpu,memory:/m\n1:name=systemd:/s\n", {"v1": {"": (9 * 10**9, 10, 0), "m": (800, 300, 100)}}, 600),
        ("0::/full\n", {"v2": {"full": (100, 150, 0)}}, 0),
    ],
)
def test_memory_of_a_container(tmp_path: Path, group: str, limits: Any, expected: int) -> None:
    assert available_memory(*machine(tmp_path, group, **limits)) == expected * MIB


def test_memory_where_nothing_can_be_read(tmp_path: Path) -> None:
    assert available_memory(tmp_path, tmp_path) == 2**30


def test_the_peak_is_this_process_s_own() -> None:
    """ru_maxrss survives exec: a child of a large process would report its parent."""
    ballast = np.ones(200 * 2**20, np.uint8)
    command = [sys.executable, "-c", "from flexgs_edge.memory.process import peak_rss; print(peak_rss())"]
    found = subprocess.run(command, capture_output=True, text=True, check=True, cwd=Path(__file__).parents[2])
    assert int(found.stdout) < ballast.nbytes
