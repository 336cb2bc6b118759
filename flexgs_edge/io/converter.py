"""Run the converter package gaussforge (extra `[formats]`) in a child process.

The converter is native code and holds whole files. The end of its process frees that memory, and a crash there becomes
an error here.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

from flexgs_edge.errors import BudgetError, FormatError, InputError
from flexgs_edge.io.formats import Format

CONVERTER = "gaussforge"
CONVERTER_MEMORY = 20 * 2**20
"""Bytes of the converter's process before it reads a file."""
_CHILD = """
import sys
import gaussforge
source, source_format, target, target_format = sys.argv[1:]
with open(source, "rb") as file:
    data = file.read()
try:
    result = gaussforge.GaussForge().convert(data, source_format, target_format)
except Exception as error:
    result = {"error": str(error) or type(error).__name__}
if "error" in result:
    sys.stderr.write("\\nconverter: " + str(result["error"]))
    sys.exit(3)
with open(target, "wb") as file:
    file.write(result["data"])
"""
_REFUSED = 3


def converter_bytes(format: Format, count: int) -> int:
    """Memory that the converter's process needs for `count` Gaussians."""
    return CONVERTER_MEMORY + format.memory * count


def check_converter(path: str | os.PathLike[str]) -> None:
    """Raise `InputError` if the converter is missing; the message tells how to install it."""
    if importlib.util.find_spec(CONVERTER) is None:
        raise InputError(f"{path}: this format needs the package {CONVERTER}: pip install 'flexgs-edge[formats]'")


def convert(path: str | os.PathLike[str], source: Path, source_format: str, target: Path, target_format: str) -> None:
    """Convert a file; `path` is the user's file, named in messages."""
    # Absolute paths, since a name with a leading dash is an option. We capture the output: the converter prints
    # progress.
    command = [sys.executable, "-c", _CHILD, os.path.abspath(source), source_format, str(target), target_format]
    done = subprocess.run(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, check=False
    )
    if done.returncode == 0:
        return
    said = done.stderr.decode("utf-8", "replace").strip().splitlines()
    last = said[-1] if said else ""
    if done.returncode == _REFUSED:
        reason = last.removeprefix("converter: ")
        if target_format == "ply":
            raise FormatError(f"{path}: not a file that {CONVERTER} can read ({reason}); is it complete?")
        raise InputError(f"{path}: {CONVERTER} cannot write this scene as {target_format} ({reason})")
    if done.returncode < 0:
        raise FormatError(
            f"{path}: {CONVERTER} crashed (signal {-done.returncode}); is the file damaged, or memory short?"
        )
    if "MemoryError" in last:
        raise BudgetError(f"{path}: memory does not suffice for {CONVERTER}, which holds the whole scene several times")
    if "OSError" in last and ("28" in last or "122" in last):
        raise BudgetError(f"{path}: the disk is full ({last})")
    raise InputError(f"{path}: {CONVERTER} failed: {last or f'exit code {done.returncode}'}")
