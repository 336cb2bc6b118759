"""Files that `compress` writes: checked before any work, published only when they are whole."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
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
def temporary_name(output: Path, force: bool) -> Iterator[Path]:
    """A name beside `output` that becomes `output` when the block ends well, and is removed when it does not."""
    target = check_writable(output, force)
    place = target.with_name(f".flexgs-{secrets.token_hex(8)}.tmp.fgs")
    try:
        yield place
        check_writable(output, force)
        os.replace(place, target)
    finally:
        with suppress(FileNotFoundError):
            place.unlink()
