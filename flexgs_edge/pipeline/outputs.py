"""Files that `compress` writes: checked before any work, published only when they are whole."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from flexgs_edge.errors import InputError
from flexgs_edge.formats import FORMATS
from flexgs_edge.pipeline.foreign import foreign_format
from flexgs_edge.pipeline.options import CompressOptions
from flexgs_edge.scene import check_writable


def check_outputs(output: str | Path | None, options: CompressOptions) -> Path | None:
    """The file to write (None in a dry run); raises `InputError` for what cannot be written."""
    if options.save_scores is not None:
        check_writable(options.save_scores, options.force)
    if options.score_cache is not None:
        check_writable(options.score_cache, force=True)
    if options.dry_run:
        return None
    if output is None:
        raise InputError("-o OUT.fgs is missing: give the file to write, or --dry-run")
    if Path(output).suffix.lower() != ".fgs" and foreign_format(output, options) is None:
        raise InputError(f"-o {output}: expected a name that ends in .fgs, {', '.join(FORMATS)}")
    check_writable(output, options.force)
    return Path(output)


@contextmanager
def temporary_name(output: Path, force: bool, word: str | None = None) -> Iterator[Path]:
    """A name in a folder beside `output` that becomes `output` when the block ends well; the folder is removed in any case.

    With a `word` the folder is named by it, and one that a killed run left is removed first.
    """
    target = check_writable(output, force)
    folder = target.with_name(f".flexgs-out-{word or secrets.token_hex(8)}")
    shutil.rmtree(folder, ignore_errors=True)
    try:
        folder.mkdir()
    except OSError as error:
        raise InputError(f"{output}: cannot write there ({error.strerror})") from error
    try:
        yield folder / f"scene{target.suffix}"
        check_writable(output, force)
        os.replace(folder / f"scene{target.suffix}", target)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
