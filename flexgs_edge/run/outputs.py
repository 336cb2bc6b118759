"""Files that `compress` writes: checked before any work, published only when they are whole."""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flexgs_edge.errors import InputError, TargetError
from flexgs_edge.files import check_writable
from flexgs_edge.io.exchange import offset_place
from flexgs_edge.io.formats import WRITTEN, Format, written_format
from flexgs_edge.run.options import CompressOptions


@dataclass(frozen=True)
class Output:
    """Where a compressed scene goes."""

    path: Path | None = None  # the file to write; `None` in a dry run
    format: Format | None = None  # another program's format; `None` for a `.fgs`
    offset: np.ndarray | None = None  # [3] f64, how far the scene was moved to zero; `None` if it was not


NO_OUTPUT = Output()  # Of commands that write no scene


def check_output(output: str | os.PathLike[str] | None, options: CompressOptions) -> Output:
    """Check every file that a run writes, before any work; raises `InputError` for what cannot be written."""
    format = _foreign_format(output, options)
    if options.score_cache is not None:
        check_writable(options.score_cache, force=True)
    if options.keep_removed is not None:
        if Path(options.keep_removed).suffix.lower() != ".ply":
            raise InputError(f"--keep-removed {options.keep_removed}: expected a name that ends in .ply")
        check_writable(options.keep_removed, options.force)
    if options.dry_run:
        return Output(None, format)
    if output is None:
        raise InputError("-o OUT.fgs is missing: give the file to write, or --dry-run")
    if Path(output).suffix.lower() != ".fgs" and format is None:
        raise InputError(f"-o {output}: expected a name that ends in .fgs, {', '.join(WRITTEN)}")
    check_writable(output, options.force)
    if options.recenter:
        check_writable(offset_place(output), options.force)
    return Output(Path(output), format)


LEAST_REFUSED = 1 << 16  # Of smaller inputs, headers alone may make a result larger: there a warning is enough


def check_smaller(size: int, input_bytes: int | None, options: CompressOptions) -> None:
    """Raise `TargetError` if a result is larger than the file that came in. `--best-effort` writes it all the same."""
    if input_bytes is not None and size > input_bytes > LEAST_REFUSED and not options.best_effort:
        method = " leave --method paper out," if options.method == "paper" else ""
        raise TargetError(
            f"the result would have {size} bytes, and the input has {input_bytes}: nothing was written. Keep the input, or"
            f"{method} ask for less: --max-size {input_bytes}, or a larger --max-drop. --best-effort writes it all the same"
        )


def _foreign_format(output: str | os.PathLike[str] | None, options: CompressOptions) -> Format | None:
    """The format that `-o` asks for, if the options fit it; `None` for `.fgs`."""
    format = None if output is None else written_format(output, options.writing)
    if format is None:
        if options.recenter or options.force_lossy:
            word = "recenter" if options.recenter else "force-lossy"
            raise InputError(f"--{word}: a .fgs holds scenes far from zero as they are; leave it out")
        return None
    if options.method == "paper":
        raise InputError(f"--method paper writes .fgs files alone, not {format.suffix}; leave it out, or write a .fgs")
    if options.layers is not None and options.layers > 1:
        raise InputError(f"--layers {options.layers}: {format.suffix} has no layers; leave it out, or write a .fgs")
    if options.preview:
        raise InputError(f"--preview {options.preview}: {format.suffix} has no preview; leave it out, or write a .fgs")
    if options.resume or options.scratch is not None:
        raise InputError(
            f"--{'resume' if options.resume else 'scratch'} works on .fgs files alone: the search for a "
            f"{format.suffix} is in memory and in one go; leave it out"
        )
    return format
