"""Reads and writes scores in NumPy files, so that a run with another target need not score again."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path

import numpy as np

from flexgs_edge.errors import InputError
from flexgs_edge.files import atomic_write


def load_scores(path: str | Path, count: int) -> np.ndarray:
    """Scores from a `.npy` file, or from a `.npz` file with one array.

    Returns
    -------
    np.ndarray
        [count] f64.

    Raises
    ------
    InputError
        When the file is not one array of `count` numbers without NaN and +inf (-inf means "never seen" and is allowed).
        The message names what was found.
    """
    path = Path(path)
    names: list[str] | None = None
    try:
        # We open the file, because np.load would leave a broken archive open.
        with open(path, "rb") as file:
            loaded = np.load(file, allow_pickle=False)
            if isinstance(loaded, np.lib.npyio.NpzFile):
                with loaded as archive:
                    names = archive.files
                    if len(names) == 1:
                        loaded = archive[names[0]]
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such score file (.npy or .npz)") from error
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{path}: not a NumPy file of scores: {error}") from error
    # Outside the `try`: an InputError is a ValueError too.
    if names is not None and len(names) != 1:
        raise InputError(f"{path}: expected one array, found {len(names)}: {', '.join(names)}")
    if loaded.shape != (count,) or loaded.dtype.kind not in "fiu":
        raise InputError(
            f"{path}: expected {count} numbers, one a Gaussian of the scene; found shape {loaded.shape}, dtype {loaded.dtype}"
        )
    scores: np.ndarray = loaded.astype(np.float64)
    bad = np.flatnonzero(np.isnan(scores) | (scores == np.inf))
    if len(bad):
        raise InputError(
            f"{path}: {len(bad)} scores are NaN or +inf, the first at row {bad[0]}: expected numbers to rank by"
        )
    return scores


def save_scores(path: str | Path, scores: np.ndarray, force: bool = False) -> None:
    """Write scores ([N] f64) as `.npy`; the file appears whole or not at all."""
    with atomic_write(Path(path), force) as file:
        np.save(file, scores)
