"""Faults for the self-test: one operator of a kernel or of a helper changed, everywhere in `cl_kernels/` in turn."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from benchmarks.harness import ROOT

KERNELS = ROOT / "cl_kernels"
OTHER = {
    "+": "-", "-": "+", "*": "+", "/": "*", "<": "<=", "<=": "<", ">": ">=", ">=": ">", "==": "!=", "!=": "==", "&": "|",
    "|": "&", "<<": ">>", ">>": "<<", "&&": "||", "||": "&&", "+=": "-=", "-=": "+=",
}  # fmt: skip
_OPERATOR = re.compile(
    r"(?<= )(?:" + "|".join(re.escape(op) for op in sorted(OTHER, key=len, reverse=True)) + r")(?= )"
)
_START = re.compile(r"^(?:__kernel|inline|#define FOR_EACH\w+\()", re.MULTILINE)
_NAME = re.compile(r"(\w+)\s*\(")
WRITTEN = {"written_fma": ("fma",)}
"""Forms of what is written out for some devices."""
SECONDS = 240
"""Time for one fault. A loop that does not end is refused too."""


@dataclass(frozen=True)
class Fault:
    """One operator of one line, replaced."""

    file: str
    function: str
    line: int
    column: int
    old: str
    new: str

    def words(self) -> str:
        """For the table: the line with the change."""
        text = (KERNELS / self.file).read_text().splitlines()[self.line - 1]
        start = max(self.column - 28, 0)
        around = text[start : self.column], text[self.column + len(self.old) : self.column + len(self.old) + 24]
        return f"`{around[0].lstrip()}`**`{self.new}`**`{around[1].rstrip()}`"

    def plant(self, folder: Path) -> None:
        """Make a copy of all kernels in `folder`, with the fault."""
        shutil.copytree(KERNELS, folder, ignore=shutil.ignore_patterns("*.py", "__pycache__"))
        lines = (folder / self.file).read_text().splitlines(keepends=True)
        line = lines[self.line - 1]
        assert line[self.column :].startswith(self.old)
        lines[self.line - 1] = line[: self.column] + self.new + line[self.column + len(self.old) :]
        (folder / self.file).write_text("".join(lines))


def faults(kernel: int = 3, helper: int = 1) -> list[Fault]:
    """So many faults of every kernel and of every helper, at even distances in its text."""
    found = []
    for path in sorted(KERNELS.glob("*.cl*")):
        text = path.read_text()
        starts = [match.start() for match in _START.finditer(text)]
        for start, end in zip(starts, [*starts[1:], len(text)], strict=True):
            head = text[start:end]
            brace = head.find("{")
            if head.startswith("#define"):
                head = head.removeprefix("#define ")
            named = _NAME.findall(re.sub(r"__attribute__\(\(.*?\)\)\)", "", head[:brace]))
            places = _places(text, start + brace, end)
            many = kernel if head.startswith(("__kernel", "FOR_EACH")) else helper
            chosen = {places[(2 * k + 1) * len(places) // (2 * many)] for k in range(many)} if places else set()
            for place in sorted(chosen):
                old = _OPERATOR.match(text, place)
                assert old is not None
                line = text.count("\n", 0, place)
                column = place - (text.rfind("\n", 0, place) + 1)
                found.append(Fault(path.name, named[0], line + 1, column, old.group(), OTHER[old.group()]))
    return found


def _places(text: str, start: int, end: int) -> list[int]:
    """Where operators are: not in comments, conditions of the preprocessor, or hints to the memory."""
    places = []
    for match in _OPERATOR.finditer(text, start, end):
        line_start = text.rfind("\n", 0, match.start()) + 1
        before = text[line_start : match.start()]
        if "//" in before or re.match(r"\s*#(?!define)|\s*//", before) or "FETCH" in before or "ahead" in before:
            continue
        places.append(match.start())
    return places


def judge(fault: Fault | None, place: Path, forms: tuple[str, ...]) -> tuple[str, str]:
    """The first form whose self-test refuses the fault, with its words; `passed` if none does."""
    folder = place / "cl_kernels"
    shutil.rmtree(folder, ignore_errors=True)
    if fault is None:
        shutil.copytree(KERNELS, folder)
    else:
        fault.plant(folder)
    environment = {**os.environ, "FLEXGS_KERNEL_DIR": str(folder), "POCL_CACHE_DIR": str(place / "pocl")}
    for form in forms:
        command = [sys.executable, "-m", "benchmarks.self_test", "play", "--form", form]
        try:
            done = subprocess.run(
                command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=SECONDS, check=False
            )
        except subprocess.TimeoutExpired:
            return form, "does not end"
        said = done.stdout.strip().splitlines()[-1:] or [f"the process ends with code {done.returncode}"]
        if said[0] != "ok":
            return form, said[0]
    return "", "passed"


def forms_of(fault: Fault) -> tuple[str, ...]:
    """Forms whose program has the file."""
    if fault.file.startswith("blend_"):
        return ("gpu4", "gpu") if fault.file == "blend_gpu.cl" else ("w16", "w1", "w4")
    return WRITTEN.get(fault.function, ("w16", "gpu", "w4"))


def judge_all(chosen: list[Fault], place: Path, workers: int, verbose: bool) -> list[tuple[Fault, str, str]]:
    """QualityEvaluator all faults; each worker has a compiler's cache of its own, so that only what changes is built."""

    def work(share: int) -> list[tuple[Fault, str, str]]:
        found = []
        for fault in chosen[share::workers]:
            form, said = judge(fault, place / str(share), forms_of(fault))
            found.append((fault, form, said))
            if verbose:
                print(
                    f"{fault.file}:{fault.line} {fault.function} {fault.old} {fault.new}: {form} {said[:150]}",
                    flush=True,
                )
        return found

    with ThreadPoolExecutor(workers) as pool:
        rows = [row for part in pool.map(work, range(workers)) for row in part]
    return sorted(rows, key=lambda row: chosen.index(row[0]))
