"""`--score-cache`: keeps scores between runs and reuses them only for the same scene, poses and kind of score."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge.errors import InputError
from flexgs_edge.files import atomic_write
from flexgs_edge.run.fingerprint import fingerprint
from flexgs_edge.run.run import Run


class ScoreCache:
    """A file with the scores of one scene seen from one set of poses.

    `path`: made by `save`. It need not exist. `fingerprint`: of the scene, poses and kind of score.
    """

    def __init__(self, path: str | Path, fingerprint: str) -> None:
        self.path, self.fingerprint = Path(path), fingerprint

    def load(self, count: int) -> np.ndarray | None:
        """[count] f64, or `None` if there is no file yet or its fingerprint differs.

        Raises `InputError` when `save` did not write the file, because the run would overwrite it.
        """
        try:
            with open(self.path, "rb") as file, np.load(file, allow_pickle=False) as archive:
                key, scores = str(archive["fingerprint"]), archive["scores"]
        except FileNotFoundError:
            return None
        except (OSError, ValueError, EOFError, KeyError, TypeError, zipfile.BadZipFile, zlib.error) as error:
            raise InputError(
                f"{self.path}: expected scores kept by score or by an earlier --score-cache, found something else ({error}); "
                "remove the file, or name another one"
            ) from error
        same = key == self.fingerprint and scores.shape == (count,) and scores.dtype == np.float64
        return scores if same else None

    def save(self, scores: np.ndarray) -> None:
        """Write the scores ([N] f64); an old file is replaced."""
        with atomic_write(self.path, force=True) as file:
            np.savez(file, fingerprint=np.array(self.fingerprint), scores=scores)


def score_cache(path: str | Path, run: Run[Any], score: str) -> ScoreCache:
    """The cache at `path`, with the fingerprint of a run and the kind of its scores."""
    options = run.options
    assert options.near is not None and options.extent is not None
    cameras = run.seen.of(run.seen.train)
    return ScoreCache(
        path, fingerprint(run.source, cameras, score, options.near, options.extent, bool(options.antialiased))
    )
