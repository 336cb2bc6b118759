"""Mutation testing: plants one fault at a time in a copy of the kernels and shows which test fails.

    python -m benchmarks.mutations                    # all: a quarter of an hour
    python -m benchmarks.mutations --only conic -v    # only faults whose name contains a word

The twins stay as they are, so the comparison with them sees every fault by construction. The tests against the float64
reference count, because it knows neither kernels nor twins. (The coder's kernels have no such reference; they are compared
with the coder in NumPy.)
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from benchmarks.harness import ROOT
from benchmarks.planted_faults import GOLDEN, MUTATIONS, Mutation, Tests

SURVIVED = "survived"


def kernel_folder(parent: Path, mutation: Mutation | None) -> Path:
    """A copy of the kernels with the fault, or without one. Raises if the text to replace does not occur."""
    folder = parent / "cl_kernels"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(ROOT / "cl_kernels", folder, ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    if mutation is not None:
        path = folder / mutation.file
        text = path.read_text()
        if mutation.old not in text:
            raise LookupError(
                f"{mutation.name}: {mutation.file} has no text {mutation.old!r}: bring the mutation up to date"
            )
        path.write_text(text.replace(mutation.old, mutation.new))
    return folder


@contextmanager
def workplace() -> Iterator[Path]:
    """A temporary folder for kernels and for the compiler's cache."""
    with tempfile.TemporaryDirectory(prefix="mutations-") as name:
        yield Path(name)


def run_tests(place: Path, files: tuple[str, ...], keywords: str) -> str | None:
    """The first test that fails on the kernels in `place`, or None."""
    environment = {**os.environ, "FLEXGS_KERNEL_DIR": str(place / "cl_kernels"), "POCL_CACHE_DIR": str(place / "pocl")}
    missing = [file for file in files if not (ROOT / file).is_file()]
    if missing:
        raise LookupError(f"no {', '.join(missing)}: bring the tests of the mutations up to date")
    command = [sys.executable, "-m", "pytest", "-x", "-v", "-p", "no:cacheprovider", "--no-cov", "-k", keywords, *files]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    failed = re.search(r"^(?:FAILED|ERROR) tests/(.+?)(?: - .*)?$", done.stdout, re.MULTILINE)
    if done.returncode < 0:  # a fault may let a kernel write anywhere: the test that ran last is the one that ended it
        failed = re.search(r"^tests/(\S+::\S+) (?!.*^tests/)", done.stdout, re.MULTILINE | re.DOTALL)
    if done.returncode > 1 or (done.returncode and not failed):
        raise RuntimeError(f"pytest ended with {done.returncode}:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
    return failed.group(1) if failed else None


def judge(place: Path, mutation: Mutation | None, tests: Tests, verbose: bool = False) -> tuple[str | None, ...]:
    """The first test that fails against the reference, against the twins, and against the golden renders."""
    kernel_folder(place, mutation)
    form = mutation.form if mutation else "(w16 or gpu)"
    found = tuple(
        run_tests(place, files, words.format(form=form)) if files else None
        for files, words in (
            (tests.reference, tests.reference_words),
            (tests.twins, tests.twin_words),
            (GOLDEN if tests.golden else (), "images or statistics"),
        )
    )
    if verbose:
        print(f"{mutation.name if mutation else 'no fault'}: {found}", flush=True)
    return found


def table(rows: list[tuple[Mutation, tuple[str | None, ...]]]) -> str:
    """All faults by the tests that see them."""
    seen: dict[str, list[str]] = {}
    drawn = [row for row in rows if row[0].tests.golden and row[0].form != "gpu" and row[0].file != "dequantize.cl"]
    golden = [bool(found[2]) for _, found in drawn]
    for mutation, (reference, twins, _) in rows:
        first = reference if mutation.reference else twins
        seen.setdefault(_test(first) if first and twins else SURVIVED, []).append(mutation.name)
    lines = [
        f"Of {len(golden)} faults in drawing, {sum(golden)} turn the golden renders of the fox scene red.",
        "The first test of each against the float64 reference, or of the twins for faults that change no value:",
        "",
        "| first test | faults |",
        "|---|---|",
    ]
    lines += [f"| {test} | {'; '.join(names)} |" for test, names in seen.items()]
    return "\n".join(lines) + "\n"


def _test(name: str) -> str:
    """The name of a test without its folder and its parameters."""
    return f"`{name.partition('[')[0].rpartition('/')[2]}`"


def main() -> int:
    """Run the mutations; returns 1 if one survives."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", metavar="WORD", help="mutations whose name holds this word")
    parser.add_argument("-v", "--verbose", action="store_true", help="a line for each mutation as it is done")
    options = parser.parse_args()
    chosen = [mutation for mutation in MUTATIONS if not options.only or options.only in mutation.name]
    with workplace() as place:
        for tests in dict.fromkeys(mutation.tests for mutation in chosen):
            healthy = judge(place, None, tests)
            if any(healthy):
                print(f"the tests fail on the kernels as they are: {healthy}", file=sys.stderr)
                return 2
        rows = [(mutation, judge(place, mutation, mutation.tests, options.verbose)) for mutation in chosen]
    print(table(rows))
    survivors = [m.name for m, found in rows if not found[1] or (m.reference and not found[0])]
    print(f"{len(rows)} faults, {len(survivors)} survived" + "".join(f"\n  {name}" for name in survivors))
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main())
